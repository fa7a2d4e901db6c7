"""What the pictures have in common: a figure that belongs to nobody else, and its file."""

from __future__ import annotations

import secrets
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import OutputError, needing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

STEPS_AXIS = "denoising step k, in order of execution (0 is the noisiest)"

FORMATS = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Suffixes of pictures; and of the metadata that matplotlib would write, what has to stay out."""

_CHARACTER = 0.012  # share of the axes' width, about, that a character of a point's name takes


def new_figure(width: float, height: float, told: str = "the figures") -> Figure:
    """An empty figure of so many inches, without pyplot, which has a global list and would choose a window system.

    ``told`` is what it will show, and ``--json`` says too; for the error.
    """
    with needing(f"a picture of {told}", "compile", f", or read {told} with --json"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def with_grid(axes: Axes) -> None:
    """Draw a faint grid behind what is drawn."""
    axes.grid(which="both", color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)


def plain_powers(axis: Axis) -> None:
    """Write 40 and 0.6 rather than 4 x 10^1 and 6e-01 on a logarithmic axis."""
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        """Labels the same ticks as its base, which writes every number below 1 as a power."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return np.format_float_positional(x, 3, fractional=False, trim="-") if super().__call__(x, pos) else ""

    axis.set_major_formatter(Plain())
    axis.set_minor_formatter(Plain(minor_thresholds=(2, 0.5)))
    axis.set_tick_params(which="minor", length=2, pad=5)
    axis.set_tick_params(which="major", length=3.5, pad=3.5)  # labels of both at one distance from the axis


def beside(place: float, name: str, shift: float = 0.0) -> dict[str, Any]:
    """How to write a name beside its point: to its right, or where that would leave the frame, to its left."""
    left = covered(place, name)[0] < place
    return {"xytext": (-5 if left else 5, shift), "textcoords": "offset points", "ha": "right" if left else "left"}


def covered(place: float, name: str) -> tuple[float, float]:
    """From where to where such a name goes, as shares of the axis."""
    long = _CHARACTER * len(name)
    return (place - long, place) if place + long > 1 else (place, place + long)


def require_picture_name(path: Path) -> None:
    """Raise unless a picture may have this name: to be told before there is something to draw."""
    if path.suffix.lower() not in FORMATS:
        raise _refused(path, f"its name ends in {path.suffix!r}, which is no format of pictures here")
    if not path.parent.is_dir():
        raise _refused(path, "there is no such folder")
    if path.exists() and not path.is_file():
        raise _refused(path, "something else than a file is there")


def encoded(figure: Figure, suffix: str = ".png") -> bytes:
    """A picture as a file has it; of the same figures the same bytes, without matplotlib's version and the date."""
    content = BytesIO()
    figure.savefig(content, format=suffix[1:], dpi=150, metadata=FORMATS[suffix])
    return content.getvalue()


def write_picture(figure: Figure, path: str | Path) -> None:
    """Write a picture in the format of its suffix (``.png``, ``.svg``, ``.pdf``), whole or not at all."""
    place = Path(path)
    require_picture_name(place)
    content = encoded(figure, place.suffix.lower())
    partial = place.with_name(f".{secrets.token_hex(8)}.partial")  # a name as long as the picture's might be too long
    try:
        partial.write_bytes(content)
        partial.replace(place)
    except OSError as error:
        raise _refused(place, str(error.strerror)) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _refused(path: Path, why: str) -> OutputError:
    remedy = "Give a name that ends in .png, .svg or .pdf, in a folder that exists and may be written to."
    return OutputError(f"{path}: the picture cannot be written: {why}. {remedy}")
