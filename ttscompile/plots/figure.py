"""What the pictures have in common: a figure that belongs to nobody else, and its file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import OutputError, RuntimeUnavailableError

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

STEPS_AXIS = "denoising step k, in order of execution (0 is the noisiest)"

_ABBREVIATIONS = {"self_attention": "SA", "cross_attention": "CA", "feed_forward": "FF"}


def new_figure(width: float, height: float, picture: str = "a picture", told: str = "the figures") -> Figure:
    """An empty figure, without pyplot, which keeps every figure in a global list and would choose a window system.

    Args:
        width: in inches.
        height: in inches.
        picture: what it will be, for the error.
        told: what ``--json`` has in its place.

    Raises:
        RuntimeUnavailableError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise RuntimeUnavailableError(
            f"{picture} needs matplotlib, and {error.name!r} is not installed. Install 'ttscompile[compile]', or read"
            f" {told} with --json."
        ) from error
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def block_names(kinds: Sequence[str]) -> list[str]:
    """Short names of blocks: ``SA 0``."""
    return [f"{_ABBREVIATIONS.get(kind, kind[:12])} {b}" for b, kind in enumerate(kinds)]


def plain_powers(axis: Axis) -> None:
    """Write 40 rather than 4 x 10^1 on a logarithmic axis."""
    from matplotlib.ticker import LogFormatter

    axis.set_major_formatter(LogFormatter())
    axis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))


def write_picture(figure: Figure, path: str | Path) -> None:
    """Write a picture; of the same figures the same bytes: matplotlib would put its version or the date into them.

    Args:
        figure: drawn.
        path: of the picture; its suffix (``.png``, ``.svg``, ``.pdf``) is the format.

    Raises:
        OutputError: it cannot be written.
    """
    metadata = {".png": {"Software": None}, ".svg": {"Date": None}}.get(Path(path).suffix)
    try:
        figure.savefig(path, dpi=150, metadata=metadata)
    except (OSError, ValueError) as error:  # no such folder; no such format
        raise OutputError(
            f"{path}: the picture cannot be written: {error}. Give a .png, .svg or .pdf in a folder that exists."
        ) from error
