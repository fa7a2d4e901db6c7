"""Options of a command in parts: each has a heading in the help, and some are of use beside another option alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import click
from click.core import ParameterSource

from ttscompile.cli.recordings import FilesCommand


@dataclass(frozen=True)
class Section:
    """Options that belong together.

    Attributes:
        needs: parameters of which one must be given where one of the options is; none for no such condition.
    """

    title: str
    options: tuple[str, ...]
    needs: tuple[str, ...] = ()


LEROBOT = Section("Policies of LeRobot", ("task", "encoders", "without_cameras", "base"))
"""Of commands that read a checkpoint."""


class SectionedCommand(FilesCommand):
    """Shows the options of each section under its title, and refuses those whose section was not asked for."""

    def __init__(self, *args: Any, sections: Sequence[Section] = (), **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.sections = tuple(sections)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As click does; then see that every option is of use."""
        rest = super().parse_args(ctx, args)
        given = {one.name: one for one in self.params if _is_given(ctx, one)}
        for section in self.sections:
            if section.needs and not given.keys() & set(section.needs):
                for option in [given[name] for name in section.options if name in given]:
                    wanted = [_word(one) for one in self.params if one.name in section.needs]
                    too = "it" if len(wanted) == 1 else "one of them"
                    raise click.UsageError(f"{_word(option)} is for {' or '.join(wanted)}: give {too} too.", ctx)
        return rest

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """A list for each section."""
        options = [one for one in self.get_params(ctx) if isinstance(one, click.Option)]
        shown = [(one.name, record) for one in options if (record := one.get_help_record(ctx)) is not None]
        placed = {name for section in self.sections for name in section.options}
        general = Section("Options", tuple(name for name, _ in shown if name is not None and name not in placed))
        for section in (general, *self.sections):
            with formatter.section(section.title):
                formatter.write_dl([record for name, record in shown if name in section.options])


def _is_given(ctx: click.Context, one: click.Parameter) -> bool:
    return one.name is not None and ctx.get_parameter_source(one.name) is ParameterSource.COMMANDLINE


def _word(option: click.Parameter) -> str:
    return max(option.opts, key=len)
