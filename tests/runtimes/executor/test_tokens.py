"""A loop whose policy reuses tokens: late calls, cameras that stand or swap, and what the trace says of it."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.families import cameras
from tests.families.cameras import moved, picture
from tests.once import Once
from tests.runtimes.all_fields import Literally
from ttscompile import AsyncExecutor, ExecutorSettings, Plan, TokenReuse
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.coercion import Array
from ttscompile.core.plan import DENSE
from ttscompile.errors import DeadlineMissedError
from ttscompile.runtimes.executor.statistics import ExecutorStatistics
from ttscompile.runtimes.frames import FrameWork
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.tokens import TokenWork

from .simulation import REAL_LIMIT, FakeClock

pytestmark = pytest.mark.slow

HZ, LATENCY, TICKS = 10.0, 0.04, 60


@pytest.fixture
def folder(once: Once, tmp_path: Path) -> Path:
    """The artifact, whose default plan reuses tokens."""
    path = shutil.copytree(cameras.compiled_tokens(once) / "artifact", tmp_path / "artifact")
    dense = load_artifact(path).plans[DENSE]
    update_plans(path, {"some": Plan(cells=dense.cells, tokens=TokenReuse(0.0, 12), repair=True)}, "some")
    return path


class Timed:
    """A compiled policy whose calls take time of a clock.

    Attributes:
        done: what it was asked for, in order: a reset, a frame to prepare, or an observation to act on; and the answer.
        works: what was done for tokens, in order.
    """

    def __init__(self, policy: CompiledPolicy, clock: FakeClock, late: Mapping[int, float]) -> None:
        self._policy, self._clock, self._late = policy, clock, late
        self._released, self._calls = threading.Condition(), 0
        self.info, self.done, self.works = policy.info, list[tuple[str, Any, Any]](), list[TokenWork]()

    @property
    def last_report(self) -> Any:
        return self._policy.last_report

    def reset(self, seed: int | None = None) -> None:
        self._policy.reset(seed)
        self.done.append(("reset", seed, None))

    def prepare_frame(self, frame: Mapping[str, Any], stop: Callable[[], bool]) -> FrameWork:
        work = self._policy.prepare_frame(frame)
        self.done.append(("prepare", frame, work))
        self.works += work.by_camera
        return work

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> dict[str, Any]:
        made = self._policy.predict_action(obs_dict, plan=plan)
        self.done.append(("predict", obs_dict, made["action_pred"]))
        assert self.last_report is not None
        self.works += self.last_report.frames.by_camera
        until, self._calls = self._clock.now() + self._late.get(self._calls, LATENCY), self._calls + 1
        with self._released:
            while self._clock.now() < until:
                self._clock.wait(self._released, until - self._clock.now())
        return made


def seen(tick: int) -> dict[str, Array]:
    """The left camera stands from tick 20 to 39, and then goes on; it is swapped with the right one from 50 to 52."""
    left, right = picture(0), picture(1)
    for step in range(tick - min(max(tick - 20, 0), 20)):
        left = moved(left, step % 36, 0.01)
    right = moved(right, tick % 7, 0.2)
    if 50 <= tick < 53:
        left, right = right, left
    return {"left": left, "right": right, "state": np.zeros(4, np.float32)}


def drive(folder: Path, late: Mapping[int, float]) -> tuple[Timed, list[dict[str, Any]], ExecutorStatistics]:
    """So many ticks of a loop with calls that are late by their number; its trace."""
    clock = FakeClock()
    policy = Timed(ttscompile.load(folder, seed=0), clock, late)
    settings = ExecutorSettings(trace_events=1000)
    executor = AsyncExecutor(policy, HZ, settings, clock=clock, latencies={"some": LATENCY}, open_timeout=REAL_LIMIT)
    clock.settle()
    try:
        for tick in range(TICKS):
            executor.observe(seen(tick))
            clock.settle()
            if executor.ready:
                try:
                    executor.action()
                except DeadlineMissedError:
                    assert late
            clock.advance(1 / HZ)
        return policy, executor.trace.to_json()["traceEvents"], executor.statistics()
    finally:
        clock.free()
        executor.close(timeout=REAL_LIMIT)


@pytest.mark.parametrize("late", [{}, {3: 0.7, 4: 0.25, 9: 1.5}], ids=["in time", "late"])
def test_late_calls_reuse_what_was_seen_last_and_nothing_else(
    folder: Path, late: Mapping[int, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each frame has what the definition says (``Literally``), and the same again where the loop is played again."""
    literally = Literally(monkeypatch, load_artifact(folder), "frame_00")
    policy, events, counts = drive(folder, late)
    assert literally.works[-len(policy.works) :] == policy.works, "before them are those of opening"
    assert (counts.deadlines_missed > 0) == bool(late)
    again = ttscompile.load(folder, seed=0)
    for what, given, made in policy.done:
        if what == "reset":
            again.reset(given)
        elif what == "prepare":
            assert again.prepare_frame(given).by_camera == made.by_camera
        else:
            np.testing.assert_array_equal(again.predict_action(given)["action_pred"], made)
    works = [work for work in policy.works if work.camera == "left"]
    assert [work.first for work in works].count(37) == 1, "the lane of a camera lives through late calls"
    steps = [work.changed for work in works if work.changed < 36]  # but for those that swapped
    assert (max(steps) > 4) == bool(late), "what changed meanwhile has added up"
    told = [work for event in events for work in event.get("args", {}).get("tokens", ())]
    assert told == [asdict(work) for work in policy.works]
    assert {event["name"] for event in events if event.get("args", {}).get("tokens")} == {"frame", "inference"}
