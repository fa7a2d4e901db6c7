"""Push-T under the executor with latencies that are given: which action is played when, and what comes of it."""

import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bootstrap import Estimate
from click.testing import CliRunner
from delays import delays_table, figures, main
from delays_plot import plot_delays
from delays_world import Driven, Setup, drive
from environments.pusht import PushT
from evaluate import summarise
from rich.console import Console
from rollout import Episode, Recorder, Rollout
from variants import NoiseShape, Variant

from ttscompile import ChunkSpec, ObservationSpec
from ttscompile.errors import WorkerDeadError

SHAPE = NoiseShape(4, (16, 2), stochastic=False)
HZ, STEPS = 50.0, 45


class Telling:
    """Its actions say where they come from: ``[100 + 10 * number of the call, 100 + 10 * index from now on]``."""

    def __init__(self, calls_until_it_fails: int = 1000) -> None:
        chunk = ChunkSpec(2, 1, 9)
        self.info = SimpleNamespace(
            observation={"obs": ObservationSpec((2, 20))},
            action=chunk,
            sample=(16, 2),
            plans=("dense",),
            default_plan="dense",
        )
        self._left = calls_until_it_fails
        self.noises: list[float] = []

    def reset(self) -> None:
        self.noises = []

    def predict_action(self, obs_dict: Mapping[str, Any], noise: Any, plan: str) -> dict[str, Any]:
        if len(self.noises) == self._left:
            raise ZeroDivisionError("scripted")
        self.noises.append(float(noise.initial[0, 0, 0]))
        index = np.arange(16, dtype=np.float32) - 1
        chunk = np.stack([np.full(16, 100 + 10 * (len(self.noises) - 1), np.float32), 100 + 10 * index], axis=1)
        return {"action_pred": chunk[None]}


def played(setup: Setup, ticks: int, seed: int = 3) -> tuple[list[tuple[int, int] | None], Driven, Telling]:
    """Number of the call and index in its chunk of the first actions; None where the agent stood still."""
    policy: Any = Telling()
    driven = drive(PushT, Variant("telling", policy, None, SHAPE), setup, seed)
    world, told = Recorder(PushT(), seed), []
    for action in driven.episode.actions[:ticks]:
        still = np.array_equal(action, world.environment.rest())
        told.append(None if still else tuple((action - 100) // 10))
        world.step(action)
    return told, driven, policy


def chunk(call: int, first: int, last: int) -> list[tuple[int, int] | None]:
    return [(call, index) for index in range(first, last + 1)]


def setup(ticks: float, margin: int = 0, horizon: int | None = None, seam: str = "replace") -> Setup:
    return Setup(1e3 * ticks / HZ, seam, margin, horizon, HZ)


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PushT, "max_steps", STEPS)


def test_without_latency_chunks_are_executed_as_if_the_world_waited() -> None:
    """But for the first tick: there is no second frame yet, and none is invented."""
    told, driven, policy = played(setup(0), 17)
    assert told == [None, *chunk(0, 0, 7), *chunk(1, 0, 7)]
    world = PushT()
    world.reset(3)
    frames = [world.observe()["obs"]]
    for action in driven.episode.actions[:9]:
        world.step(action)
        frames.append(world.observe()["obs"])
    np.testing.assert_array_equal(driven.episode.windows["obs"][:2], [frames[0:2], frames[8:10]])
    assert policy.noises[:2] == [np.random.default_rng([3, call]).standard_normal(dtype=np.float32) for call in (0, 1)]
    assert (driven.still, driven.bridged) == (1, 0)
    assert driven.age == pytest.approx(3.5, abs=0.5)


@pytest.mark.parametrize("margin", [0, 3])
def test_a_latency_skips_the_actions_that_are_overdue_and_nothing_waits_for_it(margin: int) -> None:
    """None of the first chunk is: the agent stands still until it comes."""
    told, driven, _ = played(setup(1.9, margin), 21)
    assert told == [None] * 3 + chunk(0, 0, 9) + chunk(1, 2, 9)
    assert driven.still == 3
    assert driven.age == pytest.approx(5.5, abs=0.5)


def test_a_shorter_horizon_replaces_chunks_sooner() -> None:
    told, _, _ = played(setup(1.9, horizon=4), 17)
    assert told == [None] * 3 + chunk(0, 0, 5) + chunk(1, 2, 5) + chunk(2, 2, 5)


def test_a_latency_between_ticks_counts_up_to_the_next() -> None:
    assert played(setup(1.5), 15)[0] == played(setup(1.9), 15)[0]


def test_what_is_too_slow_is_bridged_and_then_the_agent_stands_still() -> None:
    """15 actions are predicted from the observation on; 3 are held after them."""
    told, driven, _ = played(setup(20), 42)
    assert told[:21] == [None] * 21  # the chunk is wholly overdue when it comes
    assert set(told) == {None}
    assert driven.age is None
    told, driven, _ = played(setup(11), 40)
    assert told[:27] == [None] * 12 + chunk(0, 0, 10) + chunk(1, 11, 14)
    assert told[27:30] == [(1, 14)] * 3
    assert (driven.bridged, driven.still) == (6, 20)


def test_a_run_can_be_repeated() -> None:
    (first, one, _), (again, other, _) = (played(setup(3.3, 1, seam="blend"), STEPS) for _ in range(2))
    assert first == again
    np.testing.assert_array_equal(one.episode.actions, other.episode.actions)


def test_a_policy_that_fails_is_an_error_at_once() -> None:
    failing: Any = Telling(2)
    with pytest.raises(WorkerDeadError, match="ZeroDivisionError: scripted"):
        drive(PushT, Variant("telling", failing, None, SHAPE), setup(2), seed=0)


def test_a_policy_that_stands_still_is_counted_and_goes_on_with_its_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the watchdog the policy is reset within an episode, which begins no new one."""
    still = np.full((1, 16, 2), 100, np.float32)
    moving = Telling.predict_action

    def predict_action(self: Telling, *given: Any, **words: Any) -> dict[str, Any]:
        return {"action_pred": still} if moving(self, *given, **words) else {}

    monkeypatch.setattr(Telling, "predict_action", predict_action)
    driven, policy = played(replace(setup(1), stall_after=0.2), STEPS)[1:]
    # The first action is that of tick 3; at ticks 13 and 28 nothing has moved for 10: calls 17 and 33 begin anew.
    assert driven.stalls == 2 and driven.episode.calls >= 5
    last = np.random.default_rng([3, driven.episode.calls - 1]).standard_normal(dtype=np.float32)
    assert policy.noises[-1] == last and len(policy.noises) < driven.episode.calls
    assert replace(setup(1), stall_after=0.2).label == "replace, margin 0, watchdog 0.2 s"
    assert played(setup(1), STEPS)[1].stalls == 0


def episode(seed: int, best: float, calls: int) -> Episode:
    windows = {"obs": np.zeros((calls, 2, 20), np.float32)}
    return Episode(seed, "", windows, np.zeros((2, 2)), np.array([0.0, best]), False, {})


def test_the_table_and_the_picture(tmp_path: Path) -> None:
    waiting = Rollout((episode(7, 1.0, 2), episode(8, 1.0, 2)), ())
    one, two = setup(1), setup(2, horizon=8, seam="prefix")
    driven = [Driven(episode(7, 1.0, 5), 1, 0, 3.0), Driven(episode(8, 0.5, 7), 0, 2, None)]
    found = {each: figures(each, driven, waiting) for each in (one, two)}
    made = found[one]
    assert made.evaluation.score.mean == pytest.approx(0.75)
    assert (lower := made.evaluation.score_difference) is not None and lower.mean == pytest.approx(-0.25)
    assert (made.calls, made.age, made.still, made.bridged) == (6.0, 3.0, 0.25, 0.5)
    text = io.StringIO()
    baseline = summarise("the world waits", waiting, waiting)
    Console(file=text, width=200).print(delays_table("Push-T", found, baseline))
    for told in ("the world waits", "prefix, margin 0, horizon 8", "-0.250 [-0.500, 0.000]", "25.0%", "50.0%", "6.0"):
        assert told in text.getvalue()
    scores = {each: Estimate(0.5, 0.4, 0.6) for each in found}
    plot_delays(scores, baseline.score, tmp_path / "delays.png", "title")
    assert (tmp_path / "delays.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("option", "value"), [("--latency-ms", "1,-2"), ("--latency-ms", "x"), ("--margins", "inf")])
def test_wrong_lists_are_refused(tmp_path: Path, option: str, value: str) -> None:
    result = CliRunner().invoke(main, [str(tmp_path), option, value])
    assert result.exit_code == 2
    assert option in result.output
