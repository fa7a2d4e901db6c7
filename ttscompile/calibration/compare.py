"""What accuracy costs: the judge on plans of the artifact, of other artifacts, and of whoever else takes part.

Every point is a plan that a runtime executes, in its precision and with its correction, on the same held-out calls;
how far its actions are from those of the original, and what a call takes: all points take their turn, so that whatever
else the machine does hits all.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..artifact.load import Artifact, load_artifact
from ..core.coercion import integer
from ..core.plan import DENSE, Plan
from ..errors import CalibrationError
from ..measure.points import Comparison, FarCall, JudgedPlan, MeasuredPoint, pairs, rooted, signed_root
from ..runtimes.open import require_able
from ..trajectories.episodes import Episode
from .calls import digest_of, load_episodes
from .judge import Score, judge, other_noise, timed
from .progress import Bar, Progress
from .state import StateFile
from .trials import Trials

FURTHEST, LOOKED_AT = 3, 16
"""Calls of a plan that are shown since they are furthest; and among how many a page looks for them."""


@dataclass(frozen=True, eq=False)
class Entrant:
    """A plan that takes part."""

    series: str
    name: str
    trials: Trials
    plan: Plan


@dataclass(frozen=True)
class Joining:
    """Plans that take part beside those of artifacts; see ``Comparison``."""

    entrants: Sequence[Entrant] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[str] = ()


def compare(
    path: Path,
    trajectories: Sequence[Path | str],
    others: Sequence[Path] = (),
    *,
    observation: Mapping[str, Sequence[str]] | None = None,
    calls: int = 32,
    threads: int = 1,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
    plans: Sequence[str] = (),
    runtime: str = "onnxruntime",
    device: str | None = None,
    joining: Callable[[Trials, Progress], Joining] = lambda trials, progress: Joining(),
) -> Comparison:
    """Measure plans against each other.

    Args:
        path: the artifact whose dense policy is the truth.
        observation: see ``ttscompile.calibrate``.
        others: artifacts of the same policy, for instance with other samplers; their plans take part.
        calls: held-out calls, at most; half as many where the artifact has further loops (``trials.MANY_DRAWS``).
        threads: of the timed calls.
        seed: the seed of the split, the calls and the noise.
        plans: of the artifact, and of others where they have one of this name, which take part beside the dense one;
            all where none is named. ``NAME@PRECISION`` is one in another precision.
        joining: finds further plans, given the trials of the artifact, before anything is judged.

    Raises:
        CalibrationError: an artifact of another policy.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: an artifact cannot be opened.
        IllegalPlanError: the artifact has no plan of this name.
    """
    calls, threads = integer(calls, "calls", CalibrationError, 1), integer(threads, "threads", CalibrationError, 1)
    seed = integer(seed, "seed", CalibrationError)
    artifact = load_artifact(path)
    for name in plans:
        require_able(runtime, artifact, artifact.plan(name))  # refused before anything is searched for
    compared: dict[str, Artifact] = {}
    for other in others:
        name = other.resolve().name
        if name in compared:
            raise CalibrationError(f"two artifacts are called {name!r}: points could not be told apart. Rename one.")
        compared[name] = load_artifact(other)
        _require_same_policy(artifact, compared[name], name)
    episodes = load_episodes(artifact.manifest.spec, trajectories, observation, artifact.tokenizer)
    on = None if device is None else torch.device(device)
    state = StateFile(None, {})
    trials = Trials.of(artifact, episodes, state, seed=seed, observations=calls, device=on, runtime=runtime)
    joined = joining(trials, progress)
    entrants = [Entrant("this artifact", name, trials, plan) for name, plan in named_plans(artifact, plans).items()]
    entrants += joined.entrants
    for name, other_artifact in compared.items():
        own = replace(trials, artifact=other_artifact)
        entrants += [Entrant(name, plan, own, one) for plan, one in named_plans(other_artifact, plans).items()]
    points = _measured(entrants, threads, progress)
    warnings = (*_warnings(trials, compared), *joined.warnings)
    count, held_out = len(trials.held_out.calls), trials.split.validation
    return Comparison(points, count, held_out, threads, other_noise(trials), joined.skipped, warnings)


def named_plans(artifact: Artifact, names: Sequence[str] = ()) -> dict[str, Plan]:
    """The dense plan, and those of these names that an artifact has; all where none is named. See ``Artifact.plan``."""
    known = [name for name in names if name.partition("@")[0] in artifact.plans]
    return {name: artifact.plan(name) for name in (DENSE, *(known if names else artifact.plans))}


def _measured(entrants: Sequence[Entrant], threads: int, progress: Progress) -> tuple[MeasuredPoint, ...]:
    scores = []
    for number, one in enumerate(entrants):
        progress("held-out calls", number, len(entrants))
        scores.append(judge(one.trials, one.plan))
    times = timed([(one.trials, one.plan) for one in entrants], threads)
    progress("held-out calls", len(entrants), len(entrants))
    return tuple(
        MeasuredPoint(
            series=one.series,
            name=one.name,
            distance=score.distance,
            interval=score.interval,
            error=score.error,
            error_p90=score.error_p90,
            latency_ms=took.median,
            quartiles_ms=took.quartiles,
            sparsity=score.sparsity,
            outside=score.outside,
            flops=(1 - score.flops_saved) * one.trials.artifact.manifest.flops.dense,
            **_details(one.trials, score),
        )
        for one, score, took in zip(entrants, scores, times, strict=True)
    )


def _details(trials: Trials, score: Score) -> dict[str, Any]:
    """``by_number``, ``errors`` and ``furthest`` of a ``MeasuredPoint``, whose score is of the held-out calls."""
    chunk = trials.artifact.manifest.spec.chunk
    x, y = score.answers, chunk.executed(trials.held_out.answers)
    assert x is not None  # ``judge`` made the score
    each = [pairs(x[..., n], y[..., n].astype(np.float64)) for n in range(chunk.action_dim)]
    errors = (np.abs(x - y).mean((0, 1)) / chunk.scale).mean(0)
    return {
        "by_number": tuple(rooted(float(gap.mean()), float(unit.mean())) for gap, unit in each),
        "errors": () if score.error is None else tuple(errors.tolist()),
        "furthest": _shown(trials, score)[:-1],
    }


def _shown(trials: Trials, score: Score) -> tuple[FarCall, ...]:
    """The ``FURTHEST`` held-out calls, and last the one in the middle."""
    spec, sample, made = trials.artifact.manifest.spec, trials.held_out, list[FarCall]()
    x, y, gaps = score.answers, spec.chunk.executed(sample.answers), score.gaps
    assert x is not None and gaps is not None
    order = np.argsort(-gaps.h).tolist()
    for n in (*order[:FURTHEST], order[len(order) // 2]):
        episode, row = int(sample.episodes[n]), int(sample.calls[n, 1])
        seen = trials.episodes[episode].observations
        cameras = {key: seen[key][row] for key, one in spec.observations.items() if one.image}
        newest = {key: frame.reshape(-1, *frame.shape[-3:])[-1] for key, frame in cameras.items()}
        reference = spec.chunk.reference({key: frames[[row]] for key, frames in seen.items()})
        both = np.concatenate([y[n], x[n]]).astype(np.float32)
        actions = spec.chunk.unnormalized(both, reference, spec.chunk.start).reshape(2, sample.draws, *both.shape[1:])
        off = np.argsort(-np.abs(x[n, 0] - y[n, 0]).mean(0)).tolist()
        name, apart = trials.episodes[episode].name, float(signed_root(gaps.h[n]))
        made.append(FarCall(episode, name, row, apart, newest, actions, tuple(off)))
    return tuple(made)


def judge_plan(artifact: Artifact, episodes: Sequence[Episode], name: str, bar: Bar, seed: int = 0) -> JudgedPlan:
    """Judge one plan on held-out calls of at least two episodes, and look at the calls where it is furthest."""
    trials = Trials.of(artifact, episodes, StateFile(None, {}), seed=seed, observations=LOOKED_AT, bar=bar)
    score = judge(trials, artifact.plan(name))
    assert score.gaps is not None
    return JudgedPlan(name, score.gaps, _shown(trials, score), tuple(_warnings(trials, {})))


def _require_same_policy(artifact: Artifact, other: Artifact, name: str) -> None:
    """Refuse an artifact that was made from another checkpoint; says what differs."""
    specs = artifact.manifest.spec, other.manifest.spec
    ours, theirs = (
        (s.whole_horizon.sample, {k: o.shape for k, o in s.observations.items()}, s.chunk.start, s.chunk.stop)
        for s in specs
    )
    # Masks and position tables are shorter where fewer steps are predicted; the weights proper are not.
    narrower = specs[0].sample != specs[1].sample
    both = [(value, other.weights[key]) for key, value in artifact.weights.items() if key in other.weights]
    same = [np.array_equal(*pair) for pair in both if not narrower or pair[0].shape == pair[1].shape]
    if ours != theirs or not (same and all(same)):
        what = f"{theirs} instead of {ours}" if ours != theirs else "other weights"
        raise CalibrationError(
            f"{name}: expected an artifact of the same checkpoint; found {what}. Actions of different policies cannot"
            " be held against each other: convert the same checkpoint with another --sampler, --steps or --precision."
        )


def _warnings(trials: Trials, others: Mapping[str, Artifact]) -> list[str]:
    """Plans that may have been learned from the episodes that they are judged on here."""
    found, judged = [], trials.split.validation
    digest = digest_of([trials.episodes[n] for n in judged])
    for name, one in {"this artifact": trials.artifact, **others}.items():
        record = one.manifest.calibration or {}
        held_out = record.get("episodes", {}).get("validation")
        same = held_out is not None and tuple(held_out) == judged
        if one.manifest.plans and not (same and record.get("held_out", digest) == digest):
            what = "other ones of these numbers" if same else f"the episodes {held_out}"
            found.append(
                f"{name}: this comparison judges on the episodes {list(judged)}, and its calibration held out {what}."
                " If it learned from these recordings, give the same files, in the same order, and the same seed; new"
                " recordings are as good."
            )
    return found
