"""Score against latency: what a variant's speed costs on the task, with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import fill

import numpy as np
from bootstrap import Estimate
from variants import Variant, seeded_noise

from ttscompile.measure.timer import Timer
from ttscompile.measure.units import ms
from ttscompile.plots.figure import plain_powers

WARM_UP = 2
MARKERS = "osD^vP*"
"""Of the variants, from fast to slow; their number and that of the colours have no common divisor."""


@dataclass(frozen=True)
class Timed:
    """Time of a call of one variant, one stream, warm: median and 90th percentile in ms."""

    label: str
    median: float
    p90: float


def time_calls(variants: Sequence[Variant], windows: Mapping[str, np.ndarray], calls: int) -> list[Timed]:
    """Time calls of all variants in turn, call by call, so that whatever else the machine does hits all of them.

    Args:
        variants: to time.
        windows: of an episode, by key ``[N, To, ...]``; the first of them is observed.
        calls: of each, warm-up apart.
    """
    first = {key: array[:1] for key, array in windows.items()}
    for variant in variants:
        variant.policy.reset()
    timer = Timer(len(variants), WARM_UP)
    for number in range(WARM_UP + calls):
        for i in timer.round():
            variant = variants[i]
            noise = seeded_noise(variant.noise, [0], number)
            given = {} if variant.plan is None else {"plan": variant.plan}
            getattr(variant.policy, "forget_frames", lambda: None)()  # the observation is that of the call before
            timer.time(i, partial(variant.policy.predict_action, first, noise=noise, **given))
    return [
        Timed(variant.label, times.median, float(np.quantile(times.ms, 0.9)))
        for variant, times in zip(variants, timer.times, strict=True)
    ]


def plot_scores(
    names: Sequence[str], scores: Sequence[Estimate], timed: Sequence[Timed], path: Path, title: str
) -> None:
    """Draw score and its 95 % interval against latency, and write the picture.

    Args:
        names: of the variants; the first is the baseline, whose interval is a band.
        scores: one a variant.
        timed: one a variant.
        path: of the picture.
        title: over it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.axhspan(scores[0].low, scores[0].high, color="#dddddd", zorder=0, label=f"{names[0]}, 95 % interval")
    axes.axhline(scores[0].mean, color="#888888", linewidth=1, zorder=0)
    shown = sorted(zip(timed, scores, names, strict=True), key=lambda one: one[0].median)
    for number, (time, score, name) in enumerate(shown):  # names beside the points would lie on each other
        errors = [[score.mean - score.low], [score.high - score.mean]]
        told = f"{name}: {score.mean:.3f}, {ms(time.median)} ms"
        marker = MARKERS[number % len(MARKERS)]
        axes.errorbar([time.median], [score.mean], yerr=errors, fmt=marker, capsize=3, label=told)
    axes.set_xscale("log")
    plain_powers(axes.xaxis)
    axes.set_xlabel("latency of a call, ms (median)")
    axes.set_ylabel("score, mean and 95 % interval")
    axes.margins(x=0.08)
    axes.grid(which="both", color="#eeeeee", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.set_title("\n".join(fill(line, 110) for line in title.splitlines()), fontsize=8, loc="left")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    figure.savefig(path, dpi=150, metadata={"Software": None} if path.suffix == ".png" else None)
