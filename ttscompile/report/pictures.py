"""Pictures of a report as PNG: on white, whatever the page is on, so that their colours mean the same everywhere.

They are narrow, so that their text can be read where a phone makes them narrower still.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.lattice import PlanArray, Source, sparsity
from ..measure.units import ms
from ..plots.figure import encoded, new_figure
from ..plots.maps import COLOURS, plot_plan
from .page import Picture
from .timing import Measurement
from .usage import Course

_PARTS = {
    "prologue": ("#0072b2", "prologue"),
    "wait_pruner": ("#cc79a7", "wait for the pruner"),
    "decode": ("#d55e00", "denoising loop"),
    "": ("#999999", "the rest"),
}
"""Colour and name of the parts of a call."""

_DWARFS = 4.0
"""A bar is cut off where it is so many times as long as the next."""


def plain(text: str, most: int = 60) -> str:
    """Text that matplotlib draws as it stands: no formulas, no characters that its font lacks, not too long."""
    kept = "".join(c if c.isascii() and c.isprintable() and c != "$" else "?" for c in text)
    return kept if len(kept) <= most else kept[: most - 3] + "..."


def plan_picture(plan: PlanArray, kinds: Sequence[str], title: str, caption: str) -> Picture:
    """One plan, ``[K, blocks]``, and its counts, for who cannot see it; see ``ttscompile.plots.maps.plot_plan``."""
    png = encoded(plot_plan(plan, [plain(kind) for kind in kinds], plain(title)))
    counts = ", ".join(f"{source.name.lower()} {int(np.count_nonzero(plan == source))}" for source in Source)
    return Picture(png, f"{caption} {sparsity(plan):.1%} of {plan.size} cells are reused: {counts}.")


def seen_picture(course: Course) -> bytes:
    """What each camera showed in some calls: in colour where tokens were computed, pale grey where they were not.

    Framed are the first, and of the others those that took the rows of a computed one.
    """
    cameras = list(zip(*course.seen.values(), strict=True))
    figure = new_figure(1.9 * len(course.seen), 2.2 * len(cameras))
    panels = figure.subplots(len(cameras), len(course.seen), squeeze=False)
    for row, camera in zip(panels, cameras, strict=True):
        low, high = (of([of(one.pixels, axis=(1, 2)) for one in camera], axis=0) for of in (np.min, np.max))
        for axes, call, one in zip(row, course.seen, camera, strict=True):
            cut, taken = (np.kron(which, np.ones(one.patch, np.bool_)) for which in (one.computed, one.forward))
            shown = np.moveaxis(one.pixels, 0, -1)[: cut.shape[0], : cut.shape[1]]
            shown = (shown - low) / np.maximum(high - low, 1e-6)
            grey = shown.mean(-1, keepdims=True)
            colourful = shown if shown.shape[-1] == 3 else grey.repeat(3, -1)
            axes.imshow(np.where(cut[..., None], colourful, 0.6 + 0.4 * grey))
            for framed, source in ((cut, Source.COMPUTE), (taken, Source.FORWARD)):
                if framed.any() and not framed.all():
                    axes.contour(framed, levels=[0.5], colors=COLOURS[source], linewidths=1)
            count = np.count_nonzero(one.computed)
            why = "".join(f", {why}" for why in ("first", "refresh", "changed") if count and getattr(one.work, why))
            axes.set_title(f"call {call}: {count} of {one.computed.size}{why}", fontsize=7)
            axes.set_axis_off()
    return encoded(figure)


def latency_picture(measured: Sequence[Measurement]) -> bytes:
    """A bar a plan, cut into what its calls spend their time on; a bar that would dwarf the others is cut off."""
    figure = new_figure(6.0, 1.5 + 0.45 * len(measured))
    axes = figure.add_subplot()
    rows = np.arange(len(measured))[::-1]
    left = np.zeros(len(measured))
    for part, (colour, name) in _PARTS.items():
        rest = (max(one.median_ms - end, 0) for one, end in zip(measured, left, strict=True))
        widths = np.array([one.parts_ms.get(part, own) for one, own in zip(measured, rest, strict=True)])
        axes.barh(rows, widths, left=left, height=0.6, color=colour, label=name)
        left += widths
    ends = sorted(left)
    cut = len(ends) > 1 and ends[-1] > _DWARFS * ends[-2]
    limit = 1.35 * (ends[-2] if cut else ends[-1])
    axes.set_xlim(0, limit)
    axes.set_yticks(rows, [plain(one.plan, 24) for one in measured])
    for row, end, one in zip(rows, left, measured, strict=True):
        inside = bool(end > limit)
        told = f"{ms(one.median_ms)} ms" + ", cut off" * inside
        place, shift, side, colour = (limit, -6, "right", "white") if inside else (end, 4, "left", "black")
        moved: dict[str, Any] = {"xytext": (shift, 0), "textcoords": "offset points", "va": "center", "ha": side}
        axes.annotate(told, (place, row), color=colour, **moved)
    axes.set_xlabel("ms of a call, median")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return encoded(figure)
