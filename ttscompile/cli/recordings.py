"""Options of the commands that read recorded episodes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click

from ttscompile.cli.options import Decorator, together
from ttscompile.cli.types import PATH, TEXT
from ttscompile.core.paths import require_path
from ttscompile.errors import TrajectoryError

Sources = dict[str, tuple[str, ...]]
"""By key of the observation, the arrays of a recording that it is made of; of ``task``, the tokenizer's folder."""


class FilesCommand(click.Command):
    """Lets options whose metavar ends in ``...`` take every word up to the next option, which click's own cannot."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As click does, with the option repeated before every word."""
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
        return super().parse_args(ctx, expanded)


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


def require_recordings(paths: Iterable[Path]) -> None:
    """Raise TrajectoryError unless all of these exist: to be told before torch is imported, which takes seconds."""
    for path in paths:
        require_path(path, TrajectoryError, "Give the file or the directory of a recording.")


def trajectories_options(required: bool = True, what: str = "Learn from these recorded episodes.") -> Decorator:
    """``--trajectories`` as ``trajectories: tuple[Path, ...]`` and ``--observation`` as ``sources: Sources``."""
    return together(
        click.option(
            "-t",
            "--trajectories",
            required=required,
            multiple=True,
            type=PATH,
            metavar="FILE...",
            help=f"{what} They are .npz files, zarr replay buffers of Diffusion Policy, HDF5 files of robomimic, or"
            " LeRobot data sets; every word up to the next option is one.",
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
