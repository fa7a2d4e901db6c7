"""Options of a command in parts, each with a heading in the help; and those of commands that read recorded episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from ttscompile.cli.options import Decorator, together
from ttscompile.cli.types import PATH_OR_HUB, TEXT
from ttscompile.core.paths import on_hub, require_path
from ttscompile.errors import TrajectoryError

Recordings = tuple[Path | str, ...]
"""Paths, and names of data sets on the hub."""

Sources = dict[str, tuple[str, ...]]
"""By key of the observation, the arrays of a recording that it is made of; of ``task``, the tokenizer's folder."""


def _sources(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> Sources:
    found: Sources = {}
    for value in values:
        key, equals, names = value.partition("=")
        parts = tuple(name.strip() for name in names.split(","))
        if not (equals and key and all(parts)):
            raise click.BadParameter(f"{value!r}: expected KEY=NAME,NAME:N, for instance obs=keypoint,state:2.")
        if key in found:
            raise click.BadParameter(f"{key!r} is given twice.")
        found[key] = parts
    return found


def require_recordings(paths: Recordings) -> None:
    """Raise TrajectoryError unless all of these exist: to be told before torch is imported, which takes seconds."""
    for path in paths:
        if not on_hub(path):
            require_path(path, TrajectoryError, "Give a recording, or hf://datasets/ORGANISATION/NAME.")


def trajectories_options(required: bool = True, what: str = "Learn from these recorded episodes.") -> Decorator:
    """``--trajectories`` as ``trajectories: Recordings`` and ``--observation`` as ``sources: Sources``."""
    return together(
        click.option(
            "-t",
            "--trajectories",
            required=required,
            multiple=True,
            type=PATH_OR_HUB,
            metavar="FILE...",
            help=f"{what} They are .npz files, zarr replay buffers of Diffusion Policy, HDF5 files of robomimic, or"
            " LeRobot data sets, on the hub too (hf://datasets/ORGANISATION/NAME); every word up to the next option is"
            " one.",
        ),
        click.option(
            "--observation",
            "sources",
            type=TEXT,
            multiple=True,
            callback=_sources,
            metavar="KEY=NAME,NAME:N",
            help="Make a key of the observation of these arrays, joined in this order, where a recording of frames has"
            " other names. NAME:N takes the first N numbers of an array. task=DIR makes tokens of recorded"
            " instructions, with the tokenizer.json of this folder.",
        ),
    )


@dataclass(frozen=True)
class Section:
    """Options that belong together; where one is given, so must be one of the parameters that they need, if any."""

    title: str
    options: tuple[str, ...]
    needs: tuple[str, ...] = ()


LEROBOT = Section("Policies of LeRobot, and other VLAs", ("task", "encoders", "without_cameras", "base"))
"""Of commands that read a checkpoint."""


class SectionedCommand(click.Command):
    """Shows the options of each section under its title, and refuses those whose section was not asked for.

    Options whose metavar ends in ``...`` take every word up to the next option, which click's own cannot.
    """

    def __init__(self, *args: Any, sections: Sequence[Section] = (), **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.sections = tuple(sections)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As click does, with such an option repeated before every word; then see that every option is of use."""
        expanded: list[str] = []
        taking = ""
        many = {word for one in self.params if (one.metavar or "").endswith("...") for word in one.opts}
        for arg in args:
            if arg in many:
                taking = arg
            elif taking and not arg.startswith("-"):
                expanded += [taking, arg]
            else:
                taking = ""
                expanded.append(arg)
        rest = super().parse_args(ctx, expanded)
        named = {one.name: one for one in self.params if one.name is not None}
        given = {n: p for n, p in named.items() if ctx.get_parameter_source(n) is ParameterSource.COMMANDLINE}
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


def _word(option: click.Parameter) -> str:
    return max(option.opts, key=len)
