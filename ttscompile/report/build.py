"""The report of an artifact: its facts, what is measured now, and what was measured before."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..artifact.load import Artifact
from ..artifact.manifest import Manifest
from ..core.plan import DENSE
from ..measure.machine import fingerprint, one_line
from ..measure.points import JudgedPlan, Point, efficient
from ..measure.units import ms, share
from ..plots.figure import encoded
from ..plots.frontier import MOST_NUMBERS, plot_calls, plot_frontier
from ..plots.maps import plot_errors
from ..runtimes.policy import CompiledPolicy
from ..trajectories.episodes import Episode
from ..verification import Verification
from . import facts, pictures, usage
from .page import Page, Picture, Section, Table, require_packages
from .pictures import plain
from .timing import Measurement, latency, measure_plans
from .usage import Course, run_episode

NOT_RUN = Section("Verification", ("Not run for this page: --verify adds it, ttscompile verify DIR runs it alone.",))


_TOO_FAR = "too far"
"""Of what a build tried, the series of plans that it could not take."""


@dataclass(frozen=True)
class Extras:
    """What a report shows beside the artifact.

    Attributes:
        episode: recorded observations; None for none.
        verification: what was found; see ``verified``.
        judged: a plan on recorded calls; None where none was judged.
    """

    episode: Episode | None = None
    verification: Section = NOT_RUN
    judged: JudgedPlan | None = None
    calls: int = 10


def build(
    artifact: Artifact, policy: CompiledPolicy, extras: Extras, progress: Callable[[str], None] = lambda what: None
) -> Page:
    """Measure what has to be measured, draw, and put the page together.

    Args:
        policy: the same, with its default runtime and a seed.
        extras: what the report shows beside the artifact.

    Raises:
        RuntimeUnavailableError: matplotlib or Jinja2 is not installed.
    """
    manifest = artifact.manifest
    require_packages()
    progress("timing calls")
    timed = [name for name in (DENSE, *manifest.plans) if name not in facts.spare(manifest)]
    measured = measure_plans(policy, manifest.spec, timed, extras.calls)
    course = None
    if extras.episode is not None:
        progress("running an episode")
        course = run_episode(policy, extras.episode)
    progress("drawing")
    sections = (
        _frontier(artifact, measured),
        _plans(artifact, course),
        _calls(manifest, extras.judged),
        *(() if course is None else (_episode(course),)),
        _latency(measured, manifest.default_plan),
        facts.provenance(artifact),
        facts.policy(artifact),
        facts.hoisting(artifact),
        facts.blocks(manifest),
        facts.calibration(manifest),
        extras.verification,
        facts.limits(artifact),
    )
    machine = fingerprint()
    source = ", ".join(f"{value}" for value in manifest.spec.source.values()) or "A policy of the user's own network"
    return Page(
        title=f"Report on artifact {manifest.short_identity}",
        lead=" ".join((f"{source}.", *facts.chosen(manifest.calibration or {}))),
        figures=_figures(artifact, measured),
        sections=sections,
        foot=f"Made by ttscompile {machine.get('ttscompile', '')} from identity {manifest.identity}. Times: medians of"
        f" {extras.calls} calls on {one_line(machine)}.",
    )


def _figures(artifact: Artifact, measured: Sequence[Measurement]) -> tuple[tuple[str, str], ...]:
    manifest = artifact.manifest
    by_name = {one.plan: one for one in measured}
    own, dense = by_name[manifest.default_plan], by_name[DENSE]
    made = [
        ("a call now", f"{ms(own.median_ms)} ms"),
        ("faster than dense", f"{dense.median_ms / own.median_ms:.1f} x"),
        ("FLOPs saved", share(1 - (own.flops or 0) / manifest.flops.dense)),
        ("denoising steps", str(manifest.steps)),
        ("residual blocks", str(len(manifest.blocks))),
    ]
    if (score := facts.scores(manifest.calibration, ("distance",)).get(manifest.default_plan)) is not None:
        distance = facts.confirmed(manifest.calibration or {}).get(manifest.default_plan, score["distance"])
        made.append(("distance from the original", f"{distance:.3f}"))
    return tuple(made)


def _plans(artifact: Artifact, course: Course | None) -> Section:
    manifest = artifact.manifest
    kinds = [block.kind for block in manifest.blocks]
    drawn: list[Picture] = []
    own = {name: artifact.plans[name].cells for name in manifest.plans if name not in facts.spare(manifest)}
    schedules = {name: cells for name, cells in own.items() if cells is not None and manifest.plans[name].kind != "all"}
    ordered = sorted(schedules, key=lambda name: name != manifest.default_plan)
    for name in ordered:
        caption = f"Plan {name!r} of one call: steps across, blocks down."
        drawn.append(pictures.plan_picture(schedules[name], kinds, f"plan {name!r}", caption))
    if course is not None:
        last, calls = course.plans[-1], len(course.plans)
        if not any(np.array_equal(last, schedule) for schedule in schedules.values()):
            caption = f"What the last of {calls} calls of the episode executed."
            drawn.append(pictures.plan_picture(last, kinds, f"executed in call {calls - 1}", caption))
    elsewhere = "the last block of its kind (FORWARD), an earlier step (TIMESTEP) or the last call (ROLLOUT)"
    computed = "A plan says for every denoising step and every block whether it is computed"
    text = [f"{computed}, or its residual taken from {elsewhere}."]
    if not ordered:
        text.append("This artifact has no schedule to draw.")
    text += [*facts.told_spare(manifest), usage.told_unused(artifact)]
    tables = facts.plan_table(artifact), usage.usage_table(artifact)
    return Section("Plans", tuple(text), tables, tuple(drawn))


def _calls(manifest: Manifest, judged: JudgedPlan | None) -> Section:
    """In which calls a plan is furthest from the original, and how they look."""
    title = "Furthest calls"
    if judged is None:
        how = "ttscompile inspect DIR -o page.html -t calls.npz, with two recorded episodes or more, shows them"
        return Section(title, (f"The calls in which a plan is furthest from the original: {how}.",))
    gaps, middle, worst = judged.gaps, judged.shown[-1].distance, judged.shown[0].distance
    (low, high), count = gaps.interval, len(gaps.by_episode)
    told = (
        f"Plan {judged.name!r} is {gaps.distance:.3f} from the original, with 95 % confidence {low:.3f} to"
        f" {high:.3f}; 1 is what other noise changes. It was judged on {len(gaps.h)} calls of {count} recorded"
        f" episode{'s' * (count > 1)}: in half of them it is up to {middle:.3f} away, and in the worst {worst:.3f}."
    )
    hertz, chunk = (manifest.calibration or {}).get("policy_hz"), manifest.spec.chunk
    rows, titles = list[tuple[str, ...]](), list[str]()
    for one in judged.shown:
        place = "in the middle" if one is judged.shown[-1] else "furthest"
        at = [] if hertz is None else [f"{one.call * (chunk.stop - chunk.start) / hertz:.1f} s"]
        off = np.abs(one.actions[1, 0] - one.actions[0, 0]).max(0)
        numbers = ", ".join(f"{off[n]:.3g} in number {n}" for n in one.numbers[:MOST_NUMBERS])
        rows.append((place, f"{plain(one.name)}, call {one.call}", *at, f"{one.distance:.3f}", numbers))
        titles.append(f"{place}: {plain(one.name, 30)}, call {one.call}, distance {one.distance:.3f}")
    when = [] if hertz is None else ["time in its episode"]
    head = ("", "recorded call", *when, "distance", "largest difference of the actions")
    caption = "What is executed, a row for each call: the numbers of the action that differ most, in their units."
    drawn = Picture(encoded(plot_calls([*zip(titles, judged.shown, strict=True)])), caption)
    return Section(title, (told, *judged.warnings), (Table(head, tuple(rows)),), (drawn,))


def _episode(course: Course) -> Section:
    low, mean, high = (share(float(of(course.sparsity))) for of in (np.min, np.mean, np.max))
    reused = f"between {low} and {high} of the cells were reused, {mean} on average."
    if low == high:
        reused = f"{mean} of the cells were reused in each."
    found = "Every read found what it was to read."
    if replaced := sum(course.legalised):
        found = f"{replaced} cells were replaced because what they read was not computed yet."
    text = f"{len(course.plans)} consecutive calls of {course.name} with the default plan: {reused} {found}"
    drawn, work = list[Picture](), course.frames
    if course.seen:
        caption = (
            f"{work.tokens} of {work.of} tokens of new frames and scenes were computed, {share(work.tokens / work.of)};"
            f" {work.forward} took the rows of a computed one, and the others kept their own. A row is a camera. In"
            " colour: patches whose tokens were computed in this call. Pale and framed: those that took rows. They were"
            " computed since the frame is the first, or one that is refreshed whole, or since patches changed."
        )
        drawn.append(Picture(pictures.seen_picture(course), caption))
    return Section("Episode", (text,), pictures=tuple(drawn))


def _latency(measured: Sequence[Measurement], default: str) -> Section:
    alt = "Bars: what the calls of each plan spend their time on. The table has the figures."
    drawn = Picture(pictures.latency_picture(measured), "What the calls of each plan spend their time on.", alt)
    return replace(latency(measured, default), pictures=(drawn,))


def _frontier(artifact: Artifact, measured: Sequence[Measurement]) -> Section:
    manifest = artifact.manifest
    if tried := (manifest.calibration or {}).get("frontier", ()):
        points = tuple(map(_tried, tried))
        text = "The plans that the build chose among, as it judged and timed them on the machine where it ran."
    else:
        judged = facts.scores(manifest.calibration, ("distance",))
        known = [one for one in measured if one.plan in judged]
        points = tuple(
            Point("this artifact", p.plan, max(float(judged[p.plan]["distance"]), 0.0), p.median_ms) for p in known
        )
        text = "Distances from the calibration record, latencies measured now. ttscompile bench -t measures both."
    if not any(point.distance > 0 for point in points):
        return Section("Comparison", ("There is no distance to hold against a latency: calibrate the artifact first.",))
    best = efficient([point for point in points if point.series != _TOO_FAR])
    png = encoded(plot_frontier(points, best, f"artifact {manifest.short_identity}", _TOO_FAR))
    alt = "Points: distance from the original against latency of each plan. The table has the figures."
    drawn = Picture(png, "Distance from the original against latency: down and left is better.", alt)
    rows = tuple((p.series, p.name, f"{p.distance:.4g}", ms(p.latency_ms), "yes" if p in best else "") for p in points)
    head = ("", "plan", "distance", "ms a call", "on the frontier")
    return Section("Comparison", (text,), (Table(head, rows),), (drawn,))


def _tried(row: Mapping[str, Any]) -> Point:
    """A plan that a build tried; the distance of the original is 0 but for rounding."""
    if row["name"] == DENSE:
        return Point("the original", DENSE, 0.0, row["milliseconds"])
    nearness = "may be taken" if row["near"] else _TOO_FAR
    return Point(nearness, row["name"], max(float(row["distance"]), 0.0), row["milliseconds"])


def verified(found: Verification) -> Section:
    """A row a rung, what to do about the first that failed, and where residuals differ."""
    told = [f"{r.told}." + (f" First at {r.place}." if r.place else "") for r in found.rungs]
    figures = ((r.name, r.status, figure(r.figure), figure(r.tolerance), r.unit) for r in found.rungs)
    rows = tuple((*each, words) for each, words in zip(figures, told, strict=True))
    head = ("rung", "verdict", "error", "allowed", "of what", "found")
    text = f"All rungs hold; {found.seconds:.1f} s. Neither the checkpoint nor torch was needed."
    if (failure := found.first_failure) is not None:
        text = f"FAILED at {failure.name}. {failure.remedy} What fails above it may only follow from it."
    shown: tuple[Picture, ...] = ()
    if (errors := found.map) is not None:
        of = errors.errors, errors.steps.tolist(), [plain(kind) for kind in errors.kinds], errors.tolerance
        caption = "Relative error of each block's residual at the steps that were looked at: steps across, blocks down."
        if errors.plan is not None:
            caption += f" Crosses: cells of plan {errors.plan!r} that are not those stored."
        shown = (Picture(encoded(plot_errors(*of, "residuals", errors.cells)), caption),)
    return Section("Verification", (text,), (Table(head, rows),), shown)


def figure(number: float | None) -> str:
    """An error or a tolerance for people; empty if there is none."""
    return "" if number is None else f"{number:.2g}"
