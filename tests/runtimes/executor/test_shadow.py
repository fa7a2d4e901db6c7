"""Shadow mode: what is executed is the original's, whatever the compiled policy does; and what is told of it."""

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ttscompile
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor import Shadow

from .simulation import FakeClock, ScriptedPolicy, World


class Toy:
    """Its two actions are the observation, and twice it, plus ``off``; a call takes ``latency`` of the clock.

    Attributes:
        faults: by number of the call: an error to raise, or an event to wait for.
    """

    def __init__(self, clock: FakeClock, latency: float, off: tuple[float, float] = (0.0, 0.0)) -> None:
        self.clock, self.latency, self.off = clock, latency, np.array(off)
        self.faults: dict[int, Exception | threading.Event] = {}
        self.calls: list[float] = []
        self.words: list[Mapping[str, Any]] = []
        self.resets = 0
        self.followed: list[int] = []

    def reset(self, *_: int) -> None:
        self.resets += 1

    def follow(self, executed: int) -> None:
        self.followed.append(executed)

    def predict_action(self, obs: Mapping[str, Any], **words: Any) -> dict[str, Any]:
        return {"action": self.select_action(obs, **words)[:, None].repeat(3, 1)}

    def predict_action_chunk(self, obs: Mapping[str, Any], **words: Any) -> Any:
        return self.predict_action(obs, **words)["action"]

    def select_action(self, obs: Mapping[str, Any], **words: Any) -> Any:
        number, value = len(self.calls), float(obs["obs"][0, 0])
        self.calls.append(value)
        self.words.append(words)
        self.clock.advance(self.latency)
        fault = self.faults.get(number)
        if isinstance(fault, Exception):
            raise fault
        if fault is not None:
            assert fault.wait(20), "nobody let it go"
        return np.array([[value, 2 * value]]) + self.off


def seen(value: float) -> dict[str, Any]:
    return {"obs": np.array([[value]])}


def drained(shadow: Shadow) -> Shadow:
    """Once nothing waits for the compiled policy."""
    limit = time.monotonic() + 20
    while shadow._waiting:
        assert time.monotonic() < limit
        time.sleep(1e-3)
    return shadow


@pytest.fixture
def toys() -> Iterator[tuple[Toy, Toy]]:
    clock = FakeClock()
    yield Toy(clock, 0.5), Toy(clock, 0.25, (0.25, -1.0))
    assert not [one for one in threading.enumerate() if one.name == "ttscompile-shadow" and one.is_alive()]


def test_the_report_has_differences_by_dimension_the_worst_call_and_times(toys: tuple[Toy, Toy]) -> None:
    original, compiled = toys
    with closing(Shadow(original, compiled, clock=original.clock)) as shadow:
        for number in range(4):
            compiled.off = np.array([0.25, -1.0]) * (3 if number == 2 else 1)
            compiled.latency = 0.75 if number == 3 else 0.25
            answer = shadow.predict_action(seen(number))
            assert answer["action"].tolist() == [[[number, 2 * number]] * 3], "the original's"
            drained(shadow)
    found = shadow.report()
    assert (found.calls, found.compared, found.dropped, found.failed) == (4, 4, 0, 0)
    assert found.mean == pytest.approx((0.375, 1.5))
    assert found.worst == pytest.approx((1.875, 2))
    assert shadow.worst_observation is not None and shadow.worst_observation["obs"].tolist() == [[2.0]]
    assert found.late == 1, "the last one took longer than the original"
    assert found.original_ms is not None and found.original_ms.p50 == pytest.approx(500)
    assert found.compiled_ms is not None and (found.compiled_ms.min, found.compiled_ms.max) == (250, 750)
    assert found.of_other_noise is None


def test_in_units_of_other_noise_where_the_artifact_knows_them(toys: tuple[Toy, Toy]) -> None:
    original, compiled = toys
    compiled.info = SimpleNamespace(other_noise=1.25)  # type: ignore[attr-defined]
    with closing(Shadow(original, compiled)) as shadow:
        shadow.predict_action_chunk(seen(1))
    found = shadow.report()
    assert found.of_other_noise == pytest.approx(0.5)


def test_a_deadline_says_what_is_late(toys: tuple[Toy, Toy]) -> None:
    original, compiled = toys
    with closing(Shadow(original, compiled, clock=original.clock, deadline=0.2)) as shadow:
        shadow.predict_action(seen(1))
    assert shadow.report().late == 1
    for wrong in (0, "1"):
        with pytest.raises(ExecutorError, match="deadline must be a number"):
            Shadow(original, compiled, deadline=wrong)  # type: ignore[arg-type]


def test_what_fails_is_counted_and_nobody_is_told_in_the_loop(toys: tuple[Toy, Toy]) -> None:
    original, compiled = toys
    compiled.faults = {1: ZeroDivisionError("scripted")}
    with closing(Shadow(original, compiled)) as shadow:
        for number in range(3):
            assert shadow.predict_action_chunk(seen(number)).shape == (1, 3, 2)
            drained(shadow)
        assert (shadow.report().compared, shadow.report().failed, shadow.report().dropped) == (1, 1, 1)
        assert shadow.report().last_failure == "ZeroDivisionError: scripted"
        compiled.off = np.array([np.nan, 0.0])
        shadow.predict_action(seen(3))
    found = shadow.report()
    assert (found.calls, found.compared, found.failed) == (4, 1, 2) and "not finite" in found.last_failure
    assert np.isfinite(found.mean).all()


def test_an_error_of_the_original_is_the_callers_and_is_not_compared(toys: tuple[Toy, Toy]) -> None:
    original, compiled = toys
    original.faults = {0: ZeroDivisionError("scripted")}
    with closing(Shadow(original, compiled)) as shadow:
        with pytest.raises(ZeroDivisionError):
            shadow.predict_action(seen(0))
        shadow.predict_action(seen(1))
    assert (shadow.report().calls, compiled.calls) == (1, [1.0])


def test_a_compiled_policy_that_hangs_delays_nobody_and_frames_it_missed_end_its_episode(
    toys: tuple[Toy, Toy], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two calls wait; those after them are dropped, up to the next episode where frames are kept from call to call."""
    monkeypatch.setattr("ttscompile.runtimes.executor.shadow.WAITING", 2)
    original, compiled = toys
    gate = threading.Event()
    compiled.faults = {0: gate}
    with closing(Shadow(original, compiled)) as shadow:
        answers = [float(shadow.select_action(seen(number))[0, 0]) for number in range(5)]
        assert answers == [0, 1, 2, 3, 4] and shadow.report().compared == 0
        gate.set()
        drained(shadow).select_action(seen(5))
        shadow.predict_action(seen(6))
        shadow.reset()
        drained(shadow).select_action(seen(7))
    found = shadow.report()
    assert compiled.calls == [0, 1, 6, 7] and (found.compared, found.dropped) == (4, 4)
    assert (original.resets, compiled.resets) == (1, 1)


def test_what_fails_ends_its_own_episode_and_no_other(toys: tuple[Toy, Toy]) -> None:
    """Calls that wait behind the one that fails have missed its frame; those of the next episode have not."""
    original, compiled = toys
    gate = threading.Event()
    compiled.faults = {0: gate, 1: ZeroDivisionError("scripted")}
    with closing(Shadow(original, compiled)) as shadow:
        for number in range(3):
            shadow.select_action(seen(number))
        shadow.reset()
        shadow.select_action(seen(3))
        gate.set()
        drained(shadow).select_action(seen(4))
        shadow.reset()
        shadow.select_action({**seen(5), "lock": threading.Lock()})  # no copy of it can be made
        shadow.select_action(seen(6))
    found = shadow.report()
    assert compiled.calls == [0, 1, 3, 4]
    assert (found.calls, found.compared, found.failed, found.dropped) == (7, 3, 2, 2)


def test_the_observation_is_copied_and_what_belongs_to_the_plans_stays_with_the_original(toys: tuple[Toy, Toy]) -> None:
    original, compiled = toys
    original.info = compiled.info = SimpleNamespace()  # type: ignore[attr-defined]
    gate = threading.Event()
    compiled.faults = {0: gate}
    with closing(Shadow(original, compiled, noise=lambda obs: float(obs["obs"][0, 0]))) as shadow:
        obs = seen(0)
        for number in (1.0, 2.0):
            obs["obs"][:] = number
            shadow.predict_action(obs, plan="fast", prefix=None)
        obs["obs"][:] = 3.0
        shadow.follow(4)
        gate.set()
    assert compiled.calls == [1.0, 2.0] and compiled.followed == original.followed == [4]
    assert original.words == [{"prefix": None, "plan": "fast"}] * 2
    assert compiled.words == [{"prefix": None, "noise": 1.0}, {"prefix": None, "noise": 2.0}]


@pytest.mark.parametrize("fault", ["none", "raises", "hangs"])
def test_an_executor_executes_the_originals_actions(fault: str) -> None:
    """In simulated time, tick by tick what it executes without a shadow; the compiled policy runs in real time."""
    gate = threading.Event()

    def predict_action(obs: Mapping[str, Any]) -> dict[str, Any]:
        if fault == "raises":
            raise ZeroDivisionError("scripted")
        assert fault == "none" or gate.wait(20)
        return {"action": np.zeros((1, 8, 3))}

    def executed(policy: Any) -> list[list[float]]:
        with World(policy=policy) as world:
            world.begin()
            return [action.tolist() for _ in range(40) if (action := world.tick()) is not None]

    compiled = SimpleNamespace(predict_action=predict_action, reset=lambda *_: None)
    with closing(Shadow(ScriptedPolicy(FakeClock()), compiled)) as shadow:
        found = executed(shadow)
        gate.set()
    assert found == executed(ScriptedPolicy(FakeClock())) and len(found) == 40
    report = shadow.report()
    assert report.calls == len(shadow.calls) >= 5
    assert (report.compared, report.failed) == ((0, report.calls) if fault == "raises" else (report.calls, 0))


def test_two_compiled_policies_with_the_same_noise_agree(toy_compiled: Path) -> None:
    """LeRobot's loop: frame by frame, from a queue of actions."""
    policies = [ttscompile.load(toy_compiled) for _ in range(2)]
    with closing(Shadow(*policies)) as shadow:
        shadow.reset(seed=3)
        for number in range(6):
            shadow.select_action({"obs": np.full((1, 2), number / 7, np.float32)})
    found = shadow.report()
    assert (found.compared, found.failed, found.mean) == (6, 0, (0.0, 0.0))
