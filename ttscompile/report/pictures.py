"""Pictures of a report as PNG: on white, whatever the page is on, so that their colours mean the same everywhere.

They are narrow, so that their text can be read where a phone makes them narrower still.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.lattice import PlanArray, Source, sparsity
from ..measure.units import ms
from ..plots.figure import STEPS_AXIS, beside, encoded, new_figure, plain_powers, with_grid
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


def shares_picture(course: Course) -> bytes:
    """For each source that occurs, in how many of the episode's calls each cell had it."""
    shares = course.shares()
    used = [source for source in Source if shares[source].any()]
    steps, blocks = shares.shape[1:]
    figure = new_figure(min(6.0 + 0.03 * steps, 12.0), len(used) * min(1.0 + 0.09 * blocks, 6.0) + 0.6)
    panels = figure.subplots(len(used), 1, sharex=True, squeeze=False)[:, 0]
    for axes, source in zip(panels, used, strict=True):
        drawn = axes.imshow(shares[source].T, cmap="cividis", vmin=0, vmax=1, aspect="auto", interpolation="none")
        axes.set_title(f"{source.name}: {shares[source].mean():.1%} of the cells", fontsize=10, loc="left")
        axes.set_ylabel("block")
        axes.locator_params(integer=True, min_n_ticks=1)
    panels[-1].set_xlabel(STEPS_AXIS)
    figure.colorbar(drawn, ax=list(panels), label="share of the calls", pad=0.01)
    return encoded(figure)


def sparsity_picture(course: Course) -> bytes:
    """Reused cells, call by call; and those that had to be replaced."""
    figure = new_figure(6.0, 3.2)
    axes = figure.add_subplot()
    calls = np.arange(len(course.sparsity))
    axes.plot(calls, 100 * course.sparsity, color=COLOURS[Source.COMPUTE], marker="o", markersize=3, linewidth=1.2)
    axes.locator_params(axis="x", integer=True)
    axes.set(xlabel="call of the episode", ylabel="cells reused, %")
    axes.set_ylim(max(min(100 * float(course.sparsity.min()) - 2, 90.0), -2.0), 100.5)
    with_grid(axes)
    if len(replaced := np.flatnonzero(course.legalised)):
        axes.scatter(replaced, 100 * course.sparsity[replaced], marker="x", color="#0072b2", zorder=3)
        axes.set_title("crosses: cells that read what was never computed were replaced", fontsize=9, loc="left")
    return encoded(figure)


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
            axes.set_title(f"call {call}: {np.count_nonzero(one.computed)} of {one.computed.size}", fontsize=8)
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


def plans_picture(scores: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Held-out action error of each plan of a calibration against the share of cells that it computes."""
    figure = new_figure(6.0, 4.0)
    axes = figure.add_subplot()
    computed = [100 * (1 - score["sparsity"]) for score in scores.values()]
    span = (max(computed) - min(computed)) or 1.0
    errors = [score["error"] for score in scores.values()]
    for i, (name, score) in enumerate(scores.items()):
        x, middle, high = computed[i], errors[i], score["error_p90"]
        over = sum(abs(x - computed[j]) < span / 20 and abs(middle - errors[j]) < middle / 10 for j in range(i))
        axes.plot([x, x], [middle, high], color="#999999", linewidth=1, zorder=1)
        axes.plot(x, middle, "o", color=COLOURS[Source.COMPUTE], zorder=2)
        axes.plot(x, high, "_", color="#999999", markersize=10, zorder=1)
        told = plain(name, 24)
        axes.annotate(told, (x, middle), fontsize=9, **beside((x - min(computed)) / span, told, 11 * over - 3))
    axes.set_yscale("log")
    plain_powers(axes.yaxis)
    axes.set(xlabel="cells computed, %", ylabel="error of the actions, in their units")
    axes.margins(x=0.2, y=0.1)
    with_grid(axes)
    return encoded(figure)
