"""Which plan is the default of many: by distance, time and deadline."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.calibration import policies
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import pipeline
from ttscompile.calibration.choose import choose, weights_read
from ttscompile.calibration.judge import Score
from ttscompile.calibration.kept import Kept
from ttscompile.calibration.pipeline import calibrate
from ttscompile.calibration.proposer import Proposal, least_bound
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.state import FILE
from ttscompile.calibration.trials import CONFIRMING, HELD_OUT, Trials
from ttscompile.core.plan import DENSE, Plan
from ttscompile.errors import CalibrationError, CalibrationFailedError
from ttscompile.measure.timer import Times
from ttscompile.report.facts import chosen as chosen_of, limits

from .proposers.trying import request, trials_of


def score_of(distance: float, limit: float | None = None) -> Score:
    return Score(distance, (0.0, distance if limit is None else limit), None, None, 0.0, 0.0, 0.0, 1)


def chosen(
    monkeypatch: pytest.MonkeyPatch, trials: Trials, figures: Mapping[str, tuple[float, ...]], **asked: float
) -> Mapping[str, str]:
    """What the names of the artifact's plans were called while they were tried.

    Args:
        monkeypatch: fixture.
        trials: of any policy.
        figures: distance, upper end of its interval, and milliseconds of plans by name; and a fourth, that is warned
            of, where it is further away on the calls that confirm it.
        asked: of ``Request``.
    """
    kept = Kept(trials, anew=True)
    plans = {name: replace(trials.base) for name in figures}
    kept.plans |= plans
    names = {id(plan): name for name, plan in kept.plans.items()}
    figures = {DENSE: (0.0, 0.0, 100.0), **figures}

    def scored(_: Trials, plan: Plan, part: str = HELD_OUT) -> Score:
        distance, limit, _ms, *confirmed = figures[names[id(plan)]]
        distance = confirmed[0] if confirmed and part == CONFIRMING else distance
        return Score(distance, (0.0, limit), None, None, 0.0, 0.0, 0.0, 1)

    monkeypatch.setattr("ttscompile.calibration.choose.judge", scored)
    monkeypatch.setattr(
        "ttscompile.calibration.choose.timed",
        lambda entrants, threads, rounds=3: [Times((figures[names[id(plan)]][2],) * rounds) for _, plan in entrants],
    )
    warned: list[str] = []
    monkeypatch.setattr(kept.trials.bar, "warn", warned.append)
    frontier = choose(kept, request(**asked))
    assert len(warned) == (frontier.default == DENSE) + sum(len(one) > 3 for one in figures.values())
    assert (DENSE in frontier.scores) == (frontier.default == DENSE)
    found = {name: names[id(plan)] for name, plan in frontier.plans.items() if name != DENSE}
    return found if frontier.default == "schedule" else {"kept": found.pop("schedule"), **found}


def test_what_is_chosen(monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path) -> None:
    trials = trials_of(artifact, [recording])
    figures = {
        "a": (0.24, 0.60, 1.0),  # within the bound, but for its upper limit
        "b": (0.20, 0.25, 2.0),
        "c": (0.15, 0.20, 3.0),  # not much nearer than b
        "d": (0.13, 0.20, 4.0),
        "e": (0.05, 0.60, 5.0),
        "f": (0.16, 0.20, 3.5),  # slower than c and further
    }
    assert chosen(monkeypatch, trials, figures, bound=0.25) == {"schedule": "b", "safe": "d"}
    # Where a fifth of the time makes it nearer, it is nearer; what is safe has to be near enough itself, as e is not.
    closer = figures | {"g": (0.10, 0.20, 2.3)}
    assert chosen(monkeypatch, trials, closer, bound=0.25) == {"schedule": "g"}
    assert chosen(monkeypatch, trials, closer | {"g": (0.1, 0.2, 2.5)}, bound=0.25)["schedule"] == "b"
    # By a deadline the nearest that keeps it; the nearest of all, e, is not surely near enough.
    assert chosen(monkeypatch, trials, figures, bound=0.25, deadline_ms=3.2)["schedule"] == "c"
    assert chosen(monkeypatch, trials, figures, bound=0.25, deadline_ms=50.0)["schedule"] == "d"
    told = "surely within 0.25 .* keeps 1.5 ms: the fastest, 'b' .10 of 10 .*, takes 2 ms, and 2 at worst, 1.33 times"
    with pytest.raises(CalibrationFailedError, match=told + " as long. What may help: more than 1 thread .*, a larger"):
        chosen(monkeypatch, trials, figures, bound=0.25, deadline_ms=1.5)
    with pytest.raises(CalibrationFailedError, match="'c', is 0.15 away, and 0.2 at worst; 0.1 and 0.125 are"):
        chosen(monkeypatch, trials, figures, bound=0.1)
    # With a deadline, too, more time and episodes may help: that nothing is near enough need not come of it.
    with pytest.raises(CalibrationFailedError, match="What may help: more time, more episodes, more than 1 thread"):
        chosen(monkeypatch, trials, figures, bound=0.1, deadline_ms=50.0)


def test_what_may_cost_success_is_no_default_where_something_nearer_is_there(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    trials = trials_of(artifact, [recording])
    figures = {"a": (0.20, 0.25, 1.0), "b": (0.12, 0.20, 2.0), "c": (0.08, 0.12, 4.0), "d": (0.01, 0.02, 9.0)}
    bounds = {"bound": 0.1, "farthest": 0.25}
    assert chosen(monkeypatch, trials, figures, **bounds) == {"schedule": "c", "fast": "a", "safe": "d"}
    # What is fast is surely near enough for that, and of those that are as fast it is the nearest.
    surely = figures | {"a": (0.20, 0.60, 1.0)}
    assert chosen(monkeypatch, trials, surely, **bounds)["fast"] == "b"
    assert chosen(monkeypatch, trials, figures | {"e": (0.15, 0.2, 1.1)}, **bounds)["fast"] == "e"
    # By a deadline, too, what is surely near enough comes before what may be nearer; and so does what is safe.
    unsure = {"a": (0.09, 0.25, 5.0), "b": (0.095, 0.11, 5.0), "c": (0.06, 0.30, 10.0), "d": (0.06, 0.12, 12.0)}
    assert chosen(monkeypatch, trials, unsure, deadline_ms=8.0, **bounds) == {"schedule": "b", "safe": "d"}
    assert chosen(monkeypatch, trials, unsure, **bounds) == {"schedule": "b", "safe": "d"}
    # One that may be a half further than the bound is as far as some that have lost successes.
    doubtful = figures | {"c": (0.08, 0.15, 4.0)}
    assert chosen(monkeypatch, trials, doubtful, **bounds) == {"schedule": "d", "fast": "a"}
    assert chosen(monkeypatch, trials, figures, deadline_ms=5.0, **bounds)["schedule"] == "c"


def test_what_is_chosen_is_confirmed_by_other_calls(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    """What is further away there than it may be is not chosen; it may still be fast, as far as that may be."""
    trials = trials_of(artifact, [recording])
    figures: dict[str, tuple[float, ...]] = {
        "a": (0.20, 0.25, 1.0),
        "b": (0.08, 0.12, 2.0),
        "c": (0.07, 0.1, 4.0),
        "d": (0.01, 0.02, 9.0),
    }
    bounds = {"bound": 0.1, "farthest": 0.25}
    assert chosen(monkeypatch, trials, figures, **bounds) == {"schedule": "b", "fast": "a", "safe": "d"}
    unconfirmed = figures | {"b": (*figures["b"], 0.11)}
    assert chosen(monkeypatch, trials, unconfirmed, **bounds) == {"schedule": "c", "fast": "a", "safe": "d"}
    further = unconfirmed | {"a": (*figures["a"], 0.3)}
    assert chosen(monkeypatch, trials, further, **bounds) == {"schedule": "c", "fast": "b", "safe": "d"}
    unsafe = figures | {"d": (*figures["d"], 0.12)}
    assert chosen(monkeypatch, trials, unsafe, **bounds) == {"schedule": "b", "fast": "a"}
    with pytest.raises(CalibrationFailedError, match="surely within 0.1 of the original keeps 3 ms: the fastest, 'c'"):
        chosen(monkeypatch, trials, unconfirmed, deadline_ms=3.0, **bounds)


def test_nothing_that_may_cost_success_is_the_default_unasked(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    """The nearest is kept to be asked for: by ``--error``, whose value the row has, or by its name."""
    trials, bounds = trials_of(artifact, [recording]), {"bound": 0.1, "farthest": 0.25}
    figures = {"a": (0.20, 0.25, 1.0), "b": (0.12, 0.20, 2.0)}
    assert chosen(monkeypatch, trials, figures, **bounds) == {"kept": "b", "fast": "a"}
    assert chosen(monkeypatch, trials, figures, bound=least_bound(0.12, (0.0, 0.2)), farthest=0.25) == {
        "schedule": "b",
        "fast": "a",
    }
    # By a deadline the original stays the default only if it keeps it, as it does with its 100 ms.
    near_but_slow = figures | {"c": (0.08, 0.12, 4000.0)}
    assert chosen(monkeypatch, trials, near_but_slow, deadline_ms=120.0, **bounds)["kept"] == "b"
    with pytest.raises(CalibrationFailedError, match="fastest, 'c' .* takes 4e.03 ms, .*, --error 0.16, or a slower"):
        chosen(monkeypatch, trials, near_but_slow, deadline_ms=3.0, **bounds)
    # Where what keeps it is not near enough, and nothing else is, it is not time that they lack.
    told = "no plan that keeps 3 ms is surely within 0.1 .*: the nearest, 'b' .* is 0.12 away, and 0.2 at worst. What"
    with pytest.raises(
        CalibrationFailedError, match=told + " may help: more time, more episodes, .*, --error 0.16, or a"
    ):
        chosen(monkeypatch, trials, figures, deadline_ms=3.0, **bounds)


def test_where_time_was_too_short_for_a_plan_that_is_near_the_original_is_all_there_is(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    """Nothing fails for want of time, unless there is a deadline, which the original need not keep."""
    trials, figures = trials_of(artifact, [recording]), {"a": (0.01, 9.0, 1.0)}
    kept = Kept(trials, anew=True)
    kept.plans["a"] = plan = replace(trials.base)
    monkeypatch.setattr("ttscompile.calibration.choose.judge", lambda *_: score_of(*figures["a"][:2]))
    monkeypatch.setattr(
        "ttscompile.calibration.choose.timed",
        lambda entrants, *_: [Times((float(plan is not own),)) for _, own in entrants],
    )
    asked: dict[str, float]
    for asked in ({}, {"deadline_ms": 50.0}):
        with pytest.raises(CalibrationFailedError, match="no plan is near enough .*'a', is 0.01 away, and 9 at worst"):
            choose(kept, request(bound=0.1, farthest=0.25, **asked))
        trials.clock.left_out.append("search, original, 2 steps")
    del trials.clock.left_out[1:]
    frontier = choose(kept, request(bound=0.1, farthest=0.25))
    assert (frontier.default, set(frontier.plans), set(frontier.scores)) == (DENSE, {DENSE}, {DENSE})
    assert {row["name"]: row["near"] for row in frontier.tried} == {"a": False, DENSE: True}


def test_what_another_machine_may_choose_is_kept_beside(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    """Of the frontier what has no name of its own, unless another plan is as fast, or nearly as near and faster."""
    trials = trials_of(artifact, [recording])
    figures = {
        "a": (0.20, 0.22, 1.0),
        "b": (0.08, 0.09, 2.0),
        "c": (0.05, 0.06, 2.3),  # as fast as b
        "d": (0.045, 0.05, 4.0),  # hardly nearer than c
        "e": (0.03, 0.04, 6.0),
        "f": (0.02, 0.03, 8.0),
        "g": (0.04, 0.05, 9.0),  # slower than f and further
        "h": (0.01, 0.90, 9.0),  # not surely near
    }
    kept, names = Kept(trials, anew=True), dict[int, str]()
    kept.plans |= {name: replace(trials.base) for name in figures}
    names = {id(plan): name for name, plan in kept.plans.items()}
    times = {DENSE: (0.0, 0.0, 100.0), **figures}
    monkeypatch.setattr(
        "ttscompile.calibration.choose.judge",
        lambda _, plan, *__: score_of(times[names[id(plan)]][0], times[names[id(plan)]][1]),
    )
    monkeypatch.setattr(
        "ttscompile.calibration.choose.timed",
        lambda entrants, threads, rounds=3: [Times((times[names[id(plan)]][2],) * rounds) for _, plan in entrants],
    )
    refused = kept.farther["z"] = replace(trials.base), score_of(0.6)
    names[id(refused[0])], times["z"] = "z", (0.6, 0.6, 0.5)
    found = choose(kept, request(bound=0.1, farthest=0.25))
    assert found.tried[0].items() >= {"name": "z", "distance": 0.6, "milliseconds": 0.5, "near": False}.items()
    assert {name: names[id(plan)] for name, plan in found.plans.items() if name != DENSE} == {
        "schedule": "c",
        "safe": "e",
        "fast": "a",
    }
    assert [*found.spare] == ["f"] and found.spare["f"] is kept.plans["f"]
    assert {row["name"] for row in found.tried if row["kept"]} == {DENSE, "schedule", "safe", "fast", "f"}
    assert [row["name"] for row in found.tried if row["spare"]] == ["f"]
    assert found.scores.keys() == {"schedule", "safe", "fast", "f"}, "which 'bench --choose' reads"


def test_what_is_too_far_is_shown_until_a_plan_of_its_name_is_kept(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    monkeypatch.setattr("ttscompile.calibration.kept.judge", lambda *_: score_of(0.6))
    kept = Kept(trials_of(artifact, [recording]), anew=True)
    proposal = Proposal("a", replace(kept.trials.base), beside=True, refusal=lambda *_: "is too far")
    assert kept.consider(proposal) == "is too far" and kept.farther["a"][0] is proposal.plan
    assert kept.consider(replace(proposal, refusal=lambda *_: None)) is None
    assert not kept.farther and kept.plans["a"] is proposal.plan


@pytest.mark.parametrize(
    ("cores", "threads", "two", "told"),
    [
        (2, 1, 2.0, "with two a call of 'schedule' takes 2 ms in place of 3"),
        (2, 1, 2.6, ""),
        (1, 1, 2.0, ""),
        (2, 2, 2.0, ""),
    ],
)
def test_where_two_threads_are_faster_it_is_told(
    cores: int, threads: int, two: float, told: str, monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    kept = Kept(trials_of(artifact, [recording]), anew=True)
    kept.plans["a"] = replace(kept.trials.base)
    monkeypatch.setattr("ttscompile.calibration.choose.judge", lambda *_: score_of(0.01))
    monkeypatch.setattr(
        "ttscompile.calibration.choose.timed",
        lambda entrants, threads, *_: [Times(((3.0, two)[threads - 1],))] * len(entrants),
    )
    torch.set_num_threads(cores)
    choose(kept, request(threads=threads))
    assert kept.told["threads"].partition(":")[0] == told


def test_a_distance_that_is_estimated_below_0_ends_the_frontier(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    figures = {"a": (-0.1, 0.05, 1.0), "b": (-0.2, 0.04, 4.0), "c": (0.02, 0.04, 5.0)}
    named = chosen(monkeypatch, trials_of(artifact, [recording]), figures, bound=0.1, farthest=0.25)
    assert named["schedule"] == "a"


@pytest.mark.slow
def test_a_calibration_without_a_near_plan_leaves_the_original_the_default(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "choose", lambda kept, request: choose(kept, replace(request, bound=1e-9)))
    result = calibrate(artifact, [recording], learn=("loops",), max_distance=3.0, progress=False, max_minutes=1)
    made = load_artifact(artifact)
    assert result.default_plan == made.manifest.default_plan == DENSE and "schedule" in made.plans
    assert result.sparsity == 0 and not result.doubtful
    (told,) = chosen_of(made.manifest.calibration or {})
    assert told.startswith("No plan is surely within 3 of the original, so the default is 'dense'")
    assert "Its default plan computes every cell of its loop." in limits(made).points
    policy = ttscompile.load(artifact)
    assert policy.info.default_plan == DENSE
    assert policy.predict_action({"obs": np.zeros((1, 2, 3), np.float32)})["action"].shape == (1, 4, 2)


@pytest.mark.slow
def test_after_a_deadline_that_no_plan_keeps_another_error_is_chosen_from_what_was_found(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is answered or searched again."""
    how: dict[str, Any] = {"learn": ("loops",), "progress": False, "max_minutes": 2, "resume": True}

    def none(kept: Kept, asked: object) -> None:
        raise CalibrationFailedError("no plan keeps the deadline.")

    with monkeypatch.context() as late:
        late.setattr(pipeline, "choose", none)
        with pytest.raises(CalibrationFailedError, match="no plan keeps"):
            calibrate(artifact, [recording], latency_ms=1e3, max_distance=2.0, **how)
    assert (artifact / FILE).exists()
    answered = list[int]()
    monkeypatch.setattr(Runner, "run_dense", lambda self, calls: answered.append(calls.count))
    result = calibrate(artifact, [recording], max_distance=3.0, **how)
    assert not answered and result.budget == {"max_distance": 3.0} and "schedule" in load_artifact(artifact).plans


def test_weights_that_were_trained_for_one_choice_are_no_other_ones(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(kept: Kept, *_: object) -> None:
        kept.trials.state.save()
        raise CalibrationFailedError("enough.")

    monkeypatch.setattr(pipeline, "_hear", end)
    how: dict[str, Any] = {"learn": ("loops", "weights"), "progress": False, "resume": True}
    with pytest.raises(CalibrationFailedError, match="enough"):
        calibrate(artifact, [recording], max_distance=0.1, **how)
    with pytest.raises(CalibrationError, match=r"max_distance was 0.1, now 0.2"):
        calibrate(artifact, [recording], max_distance=0.2, **how)


def test_by_a_deadline_the_nearest_are_timed_until_99_of_100_calls_are_known(
    monkeypatch: pytest.MonkeyPatch, artifact: Path, recording: Path
) -> None:
    """One slow call of sixteen does not exclude a plan, and five of 200 do."""
    kept, rounds = Kept(trials_of(artifact, [recording]), anew=True), list[tuple[int, int]]()
    slow = {"hiccup": 1, "late": 5, "last": 1, DENSE: 0}  # of 200 calls
    kept.plans |= {name: replace(kept.trials.base) for name in ("late", "hiccup", "last")}
    names = {id(plan): name for name, plan in kept.plans.items()}
    far = {"late": 0.01, "hiccup": 0.02, "last": 0.03, DENSE: 0.0}
    monkeypatch.setattr("ttscompile.calibration.choose.judge", lambda _, plan, *__: score_of(far[names[id(plan)]]))

    def timed(entrants: Sequence[tuple[Trials, Plan]], threads: int, calls: int = 16) -> list[Times]:
        rounds.append((len(entrants), calls))
        count = [slow[names[id(plan)]] for _, plan in entrants]
        return [Times((9.0,) * some + (1.0,) * (calls - some)) for some in count]

    monkeypatch.setattr("ttscompile.calibration.choose.timed", timed)
    frontier = choose(kept, request(deadline_ms=5.0))
    assert names[id(frontier.plans["schedule"])] == "hiccup"
    assert rounds == [(4, 16), (2, 200)], "the third is not as near"
    (row,) = (row for row in frontier.tried if row["name"] == "schedule")
    assert (row["worst"], row["calls"]) == (1.0, 200)


def test_weights_are_those_that_the_models_of_a_plan_read(tmp_path: Path) -> None:
    """Of three layers of ``Mixer`` in eight bits less than in fp32, whatever else the artifact holds."""
    module, path = policies.Mixer(0).eval(), tmp_path / "mixer"
    ttscompile.compile_denoiser(module, policies.spec(), path, precision="int8")
    made = load_artifact(path)
    whole, narrow = (weights_read(made, made.plan(name)) for name in (DENSE, "dense@int8"))
    large = sum(4 * one.weight.numel() for one in (*module.wide, *module.narrow))
    stored = {name: one.bytes for name, one in made.manifest.files.items() if name.endswith(".safetensors")}
    assert large < whole < sum(stored.values()) - stored["golden.safetensors"] - stored["weights_int8.safetensors"]
    assert large / 2 < whole - narrow < large, "each weight is a quarter as long, and has a scale"
