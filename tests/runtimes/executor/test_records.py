"""Statistics and traces: of a fixed size, and in the form that other tools read."""

import errno
import inspect
import json
from dataclasses import FrozenInstanceError, fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ttscompile.runtimes.executor.statistics import (
    CONTROL,
    COUNTS,
    MEASURED,
    WORKER,
    ExecutorStatistics,
    Recorder,
    Samples,
    Trace,
    statistics,
    summary,
)
from ttscompile.runtimes.report import Timings

from .simulation import ScriptedPolicy, World


def test_percentiles_are_of_the_last_measurements_and_extremes_of_all() -> None:
    samples = Samples(100)
    assert summary(*samples.copy()) is None
    for value in [1000.0, -5.0, *range(200)]:
        samples.add(value)
    made = summary(*samples.copy())
    last = np.arange(100, 200)
    assert made is not None
    assert (made.count, made.min, made.max) == (202, -5, 1000)
    assert (made.p50, made.p95, made.p99) == tuple(np.percentile(last, [50, 95, 99]))


def test_statistics_do_not_grow() -> None:
    recorder = Recorder(16)
    before = {name: value.copy()[0].nbytes for name, value in vars(recorder.samples).items()}
    for i in range(1000):
        recorder.tick(0.1 * i)
    assert len(recorder.samples.tick_ms.copy()[0]) == 16
    assert set(before.values()) == {0}
    assert recorder.counts.ticks == 1000


def test_every_count_has_its_place_in_the_statistics() -> None:
    names = {field.name for field in fields(ExecutorStatistics)}
    assert names == {*COUNTS, *MEASURED, "plan", "identity", "last_refusal"}
    assert (len(COUNTS), len(MEASURED)) == (20, 6)
    made = statistics("plan", Recorder(4).copy())
    assert json.loads(json.dumps(made.to_json(), allow_nan=False))["plan"] == "plan"
    for name in names:
        assert f"\n    {name}: " in str(inspect.getdoc(ExecutorStatistics))


def test_what_a_user_gets_cannot_be_changed() -> None:
    with World() as world:
        world.begin()
        made = world.executor.statistics()
        world.executor.feasibility().clear()
        for record in (made, made.latency_ms, world.executor.feasibility()["dense"], world.executor.frames):
            assert record is not None
            for field in fields(record):
                with pytest.raises(FrozenInstanceError):
                    setattr(record, field.name, 0)


def test_the_control_rate_is_measured() -> None:
    with World() as world:
        world.run(20)
        measured = world.executor.statistics().tick_ms
        assert measured is not None and measured.p50 == pytest.approx(100)


def test_a_trace_is_what_perfetto_reads(tmp_path: Path) -> None:
    trace = Trace(10)
    trace.span(WORKER, "inference", 5.0, 0.25, {"plan": "dense"})
    trace.span(CONTROL, "tick", 4.0, 0.001)
    trace.instant(CONTROL, "reset", 4.5)
    trace.write(tmp_path / "trace.json", "a robot")
    document = json.loads((tmp_path / "trace.json").read_text())
    meta = [event for event in document["traceEvents"] if event["ph"] == "M"]
    assert {event["args"]["name"] for event in meta} == {"a robot", "control loop", "policy", "pruner"}
    events = [event for event in document["traceEvents"] if event["ph"] != "M"]
    assert events == [
        {"ph": "X", "name": "tick", "pid": 1, "tid": CONTROL, "ts": 0.0, "dur": 1000.0},
        {"ph": "i", "name": "reset", "pid": 1, "tid": CONTROL, "ts": 5e5, "s": "t"},
        {"ph": "X", "name": "inference", "pid": 1, "tid": WORKER, "ts": 1e6, "dur": 2.5e5, "args": {"plan": "dense"}},
    ]


def test_a_trace_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk leaves the trace of before."""
    trace, path = Trace(10), tmp_path / "trace.json"
    trace.write(path)
    before = path.read_bytes()
    trace.instant(CONTROL, "reset", 1.0)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("ttscompile.artifact.files.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        trace.write(path)
    assert [each.name for each in tmp_path.iterdir()] == ["trace.json"]
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("wait", "decode"), [(5, (3.5e4, 6e4)), (2, (3e4, 6.2e4))], ids=["pruner first", "beside step 0"]
)
def test_the_parts_of_a_call_stand_within_it(wait: float, decode: tuple[float, float]) -> None:
    trace = Trace(10)
    trace.call(1.0, 1.1, {"plan": "p"}, Timings(prologue=10, pruner=5, wait_pruner=wait, decode=60, total=80))
    events = [e for e in trace.to_json()["traceEvents"] if e["ph"] == "X"]
    found = {e["name"]: (e["ts"], e["dur"]) for e in events}
    expected = {"inference": (0, 1e5), "prologue": (2e4, 1e4), "pruner": (3e4, 5e3), "decode": decode}
    assert found.keys() == expected.keys()
    for name, times in expected.items():
        assert found[name] == pytest.approx(times)
    assert {e["name"]: e["tid"] for e in events} == {"inference": 2, "prologue": 2, "pruner": 3, "decode": 2}


def test_a_trace_keeps_the_last_events() -> None:
    trace = Trace(5)
    for i in range(12):
        trace.instant(CONTROL, str(i), float(i))
    names = [event["name"] for event in trace.to_json()["traceEvents"] if event["ph"] != "M"]
    assert names == ["7", "8", "9", "10", "11"]
    off = Trace(0)
    off.instant(CONTROL, "x", 0.0)
    assert not off.on
    assert len(off.to_json()["traceEvents"]) == 4


def test_a_run_leaves_ticks_calls_and_resets_in_the_trace() -> None:
    with World() as world:
        world.run(10)
        world.executor.reset()
        world.tick(action=False)
        events = world.executor.trace.to_json()["traceEvents"]
    names = [event["name"] for event in events]
    assert names.count("tick") == 11
    assert names.count("reset") == 1
    calls = [event for event in events if event["name"] == "inference"]
    assert len(calls) == len(world.policy.calls)
    assert all(event["dur"] == pytest.approx(1e5) for event in calls)
    assert calls[0]["args"] == {"plan": "dense", "epoch": 0, "chunk": "scheduled"}


def test_calls_far_outside_of_what_was_recorded_are_counted() -> None:
    """Every third is, by the report of the policy."""
    with World() as world:
        far = property(lambda policy: SimpleNamespace(far=len(policy.calls) % 3 == 0, timings=None, frames=None))
        world.policy.__class__ = type("Reporting", (ScriptedPolicy,), {"last_report": far})
        world.run(60)
        counted = world.executor.statistics()
        events = world.executor.trace.to_json()["traceEvents"]
    assert counted.calls == len(world.policy.calls) > 6
    assert counted.calls_outside == counted.calls // 3
    assert counted.to_json()["calls_outside"] == counted.calls_outside
    marked = [event["args"].get("outside", False) for event in events if event["name"] == "inference"]
    assert marked == [number % 3 == 0 for number in range(1, counted.calls + 1)]
