"""When calls start: the state machine alone, against the arithmetic of feasibility, at random rates and delays."""

from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ttscompile import ChunkSpec, ObservationSpec
from ttscompile.runtimes.executor import ExecutorSettings, Feasibility
from ttscompile.runtimes.executor.feasibility import LatencyWindow
from ttscompile.runtimes.executor.settings import resolve
from ttscompile.runtimes.executor.state import ExecutorState, Job

from .simulation import Facts, World


@dataclass
class Loop:
    """A control loop over a policy of given latencies; times in seconds.

    Attributes:
        horizon: actions that the policy executes.
        beyond: actions that it predicts after these.
        frame_hz: of the camera; None: as the policy's.
        offset: from a control tick to when a frame is taken.
        delay: until it comes.
        jitter: at most so much later.
        ahead: how much sooner than for its time an action is asked for.
        took: latency of a call by its number, for those that take another time than their plan.
    """

    control_hz: float = 50.0
    horizon: int = 8
    beyond: int = 7
    latency: dict[str, float] = field(default_factory=lambda: {"dense": 0.078})
    settings: dict[str, Any] = field(default_factory=dict)
    frame_hz: float | None = None
    offset: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    ahead: float = 0.0
    took: dict[int, float] = field(default_factory=dict)

    # C901: its functions are the events
    def run(self, chunks: int = 12) -> tuple[list[Job], SimpleNamespace, Feasibility]:  # noqa: C901
        """Calls, counts, and the arithmetic of the first plan."""
        plans = tuple(self.latency)
        spec, chunk = ObservationSpec((2, 1)), ChunkSpec(1, 1, 1 + self.horizon)
        facts: Any = Facts({"obs": spec}, chunk, (1 + self.horizon + self.beyond, 1), plans, plans[0])
        given = ExecutorSettings(max_hold=10**6, tiers=plans, **self.settings)
        resolved = resolve(given, facts, self.control_hz)
        windows = {plan: LatencyWindow(given.latency_window) for plan in plans}
        for plan, seconds in self.latency.items():
            windows[plan].add(seconds)
        state = ExecutorState(resolved, None, plans, windows)
        calls: list[Job] = []
        job: Job | None = None
        rng, order = np.random.default_rng(0), count()
        events: list[tuple[float, int, Callable[[float], None]]] = []

        def at(when: float, what: Callable[[float], None]) -> None:
            heappush(events, (when, next(order), what))

        def work(now: float) -> None:
            nonlocal job
            start = None if job is not None else state.next_start(now)
            if start is not None and start > now:
                at(start, work)
            elif start is not None:
                job = state.begin(now)
                at(now + self.took.get(len(calls), self.latency[job.plan]), done)
                calls.append(job)

        def done(now: float) -> None:
            nonlocal job
            assert job is not None
            finished, job = job, None
            state.finish(finished, np.zeros((resolved.horizon + resolved.reserve, 1), np.float32), now)
            work(now)

        def observe(taken: float) -> Callable[[float], None]:
            def come(now: float) -> None:
                state.observe({"obs": np.zeros(1, np.float32)}, taken, now)
                work(now)

            return come

        def act(now: float) -> None:
            if state.play(now + self.ahead, now) is None:
                state.hold(now + self.ahead, now)

        frame = 1 / (self.frame_hz or resolved.policy_hz)
        seconds = chunks * (resolved.horizon + resolved.reserve) / resolved.policy_hz + 3 * max(self.latency.values())
        for i in range(int(seconds / frame) + 3):
            taken = 1000 + self.offset + i * frame
            at(taken + self.delay + self.jitter * rng.uniform(), observe(taken))
        for i in range(int(seconds * self.control_hz)):
            at(1000 + i / self.control_hz, act)
        while events[0][0] < 1000 + seconds:
            when, _, what = heappop(events)
            what(when)
        return calls, state.recorder.counts, resolved.feasibility(max(self.latency.values()))


def apart(calls: list[Job]) -> list[float]:
    """Seconds between the frames of calls, but for the first two."""
    return [after.observed - before.observed for before, after in pairwise(calls)][1:]


@pytest.mark.parametrize("offset", [0.0, 0.004, 0.009, 0.014])
@pytest.mark.parametrize("delay", [0.0, 0.01, 0.03, 0.055])
def test_neither_the_phase_of_the_frames_nor_their_delay_changes_when_calls_start(offset: float, delay: float) -> None:
    """A camera takes its pictures between two ticks, and they take a while to come: no call is made of an older one."""
    loop = Loop(settings={"policy_hz": 10.0}, offset=offset, delay=delay)
    calls, counts, _ = loop.run()
    assert apart(calls) == pytest.approx([0.8] * (len(calls) - 2))
    assert [job.started - job.observed for job in calls] == pytest.approx([delay] * len(calls))
    assert counts.deadlines_missed == 0


@pytest.mark.parametrize("plans", [{"dense": 0.02}, {"slow": 0.02, "fast": 0.01}])
@pytest.mark.parametrize("ahead", [0.02, 0.06, 0.1, 0.15])
def test_actions_that_are_asked_for_ahead_are_needed_sooner(plans: dict[str, float], ahead: float) -> None:
    """For the latency of an actuator. Push-T at 50 Hz: 300 ms of actions, of which calls and a frame take 80."""
    calls, counts, _ = Loop(latency=plans, ahead=ahead).run(30)
    assert (counts.deadlines_missed, counts.reserve, counts.holds, counts.switches_down) == (0, 0, 0, 0)
    assert min(apart(calls)) == pytest.approx(0.16 if ahead < 0.1 else 0.14 if ahead < 0.15 else 0.08, abs=0.021)
    assert all(job.deadline is None or job.started < job.deadline for job in calls)


def test_another_tier_does_not_change_how_far_calls_are_apart() -> None:
    """The fourth call is late; ``fast`` runs until it is over. What is planned with is what the next plan takes."""
    loop = Loop(10.0, 8, 20, {"slow": 0.4, "fast": 0.05}, {"up_after": 3}, took={3: 1.5})
    calls, counts, _ = loop.run()
    assert (counts.switches_down, counts.switches_up, counts.deadlines_missed) == (1, 1, 1)
    assert [job.plan for job in calls[3:8]] == ["slow", "fast", "fast", "fast", "slow"]
    distances = apart(calls)
    assert distances.pop(2) == pytest.approx(1.5)  # from the late call to the one after it
    assert distances == pytest.approx([0.8] * len(distances))


def test_an_exception_that_no_schedule_covers_changes_nothing_after_it() -> None:
    """The fifth call takes 310 ms, where 130 can be covered: those after it are 8 actions apart, as before."""
    calls, counts, _ = Loop(latency={"dense": 0.038}, took={4: 0.31}).run(30)
    distances = apart(calls)
    assert distances.pop(3) == pytest.approx(0.3)  # to the newest frame when it is done
    assert distances == pytest.approx([0.16] * len(distances))
    assert len(calls) > 50
    assert counts.deadlines_missed == 1


def test_where_calls_take_longer_than_can_be_covered_they_follow_each_other_at_once() -> None:
    calls, _, _ = Loop(latency={"dense": 0.038}, took=dict.fromkeys(range(4, 100), 0.21)).run(30)
    assert sum(apart(calls)[-8:]) == pytest.approx(8 * 0.21)


@pytest.mark.parametrize(
    ("latencies", "reckoned"), [([1, 2, 1], 2), ([1, 9, 2], 2), ([9, 1, 9], 9), ([5], 5), ([3], 3)]
)
def test_what_a_call_is_reckoned_to_take(latencies: list[float], reckoned: float) -> None:
    window = LatencyWindow(3)
    for each in latencies:
        window.add(each)
    assert window.reckoned(most=4) == reckoned


def test_a_policy_that_executes_one_action_of_many_keeps_up() -> None:
    """A call a frame, each done before the next."""
    calls, counts, arithmetic = Loop(10.0, 1, 15, {"dense": 0.05}).run(4)
    assert arithmetic.feasible
    assert apart(calls) == pytest.approx([0.1] * (len(calls) - 2))
    assert counts.deadlines_missed == 0


def test_the_frame_before_is_used_when_the_next_does_not_come() -> None:
    """The calls are shorter than a tick: nothing new had been observed when the worker began to wait."""
    with World(latency={"dense": 0.03}) as world:
        world.begin()
        for tick in range(20):
            world.tick(observe=tick != 5)  # that of 0.73
        first = [(round(when - world.start, 6), round(obs[0, -1, 1], 6)) for when, _, obs in world.policy.calls[:2]]
        assert first == [(0.1, 0.1), (0.8, 0.63)]
        assert world.executor.statistics().deadlines_missed == 0


@settings(deadline=None, max_examples=60, derandomize=True)
@given(
    rate=st.sampled_from([5.0, 10.0, 50.0]),
    ticks_per_step=st.sampled_from([1, 2, 5]),
    horizon=st.sampled_from([1, 2, 3, 8]),
    beyond=st.sampled_from([0, 1, 7, 20]),
    margin=st.sampled_from([1, 3]),
    reserve=st.sampled_from([None, 0]),
    often=st.booleans(),
    phase=st.floats(0, 0.99),
    share=st.floats(0.02, 0.97),
    jitter=st.sampled_from([0.0, 0.3]),
    ahead=st.sampled_from([0.0, 0.1, 0.4]),
    feasible=st.booleans(),
)
def test_what_is_feasible_never_misses_and_what_clearly_is_not_does(  # noqa: PLR0913  # drawn by hypothesis
    rate: float,
    ticks_per_step: int,
    horizon: int,
    beyond: int,
    margin: int,
    reserve: int | None,
    often: bool,
    phase: float,
    share: float,
    jitter: float,
    ahead: float,
    feasible: bool,
) -> None:
    """Clearly: by more than a frame, which a call need not wait for if the phase is lucky, and a margin."""
    hz = rate * ticks_per_step
    own = Feasibility(1.0, hz, rate, horizon, margin, beyond if reserve is None else 0)
    spare = own.predicted - own.frame_period - own.margin - 1 / hz  # else a late frame costs a call
    ahead = min(ahead, max(spare, 0.0) / 2)
    longest = min(own.play, own.max_latency, (own.predicted - own.frame_period - own.margin - ahead) / 2)
    latency = (
        share * longest if feasible else max(longest, 0.0) + 1.3 / rate + (margin + 1.6) / hz + share * horizon / rate
    )
    if latency <= 0:
        return
    loop = Loop(
        hz,
        horizon,
        beyond,
        {"dense": latency},
        {"policy_hz": rate, "margin_ticks": margin, "reserve": reserve},
        frame_hz=hz if often else rate,
        offset=phase / hz,
        jitter=jitter / hz,
        ahead=ahead,
    )
    loop.settings["refuse_infeasible"] = False
    _, counts, arithmetic = loop.run(6)
    assert arithmetic.feasible == feasible
    if feasible:
        assert (counts.deadlines_missed, counts.chunks_overdue, counts.reserve) == (0, 0, 0)
    elif counts.chunks > 1:
        assert counts.deadlines_missed > 0
