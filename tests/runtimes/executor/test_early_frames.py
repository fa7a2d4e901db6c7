"""Frames are prepared while nothing waits for them; whatever comes late, twice or never, no call sees anything else."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ttscompile import ObservationSpec
from ttscompile.errors import ExecutorError, WorkerDeadError
from ttscompile.runtimes.executor import ExecutorSettings
from ttscompile.runtimes.frames import FrameWork
from ttscompile.runtimes.queues import Queues

from .simulation import TA, TO, Facts, FakeClock, ScriptedPolicy, World

LATENCY, COST, ROWS = 0.1, 0.06, 2


@dataclass(frozen=True)
class SeeingFacts(Facts):
    frames: int = 1


@dataclass
class SeeingPolicy(ScriptedPolicy):
    """Each frame has two pieces of work, which are known by content once they are done.

    Attributes:
        cost: seconds of a frame.
        breaks: number of the piece of work that raises.
        early: time and content of every frame that was prepared.
        begun: when each call was made.
        waited: pieces of work that each call had to do itself.
    """

    cost: float = COST
    breaks: int | None = None
    early: list[tuple[float, bytes]] = field(default_factory=list)
    begun: list[float] = field(default_factory=list)
    waited: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.info = SeeingFacts(**vars(self.info))
        self.known: set[tuple[int, bytes]] = set()
        self.works = 0

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.known.clear()

    def prepare_frame(self, frame: Mapping[str, Any], stop: Callable[[], bool]) -> FrameWork:
        content, computed = frame["obs"][0].tobytes(), 0
        self.early.append((self.clock.now(), content))
        for row in range(ROWS):
            if (row, content) not in self.known:
                if stop():
                    break
                self.work(row, content)
                computed += 1
        return FrameWork(computed=computed)

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> dict[str, Any]:
        wanted = {(row, frame.tobytes()) for frame in obs_dict["obs"][0] for row in range(ROWS)}
        self.begun.append(self.clock.now())
        self.waited.append(len(wanted - self.known))
        for row, content in sorted(wanted - self.known):
            self.work(row, content)
        return super().predict_action(obs_dict, plan=plan)

    def work(self, row: int, content: bytes) -> None:
        self.works += 1
        if self.works - 1 == self.breaks:
            raise ZeroDivisionError("scripted")
        self._take(self.cost / ROWS, False)
        self.known.add((row, content))


def seeing(cost: float = COST, breaks: int | None = None, hz: float = 10.0, reserve: int = 0) -> World:
    policy = SeeingPolicy(FakeClock(), {"dense": LATENCY}, cost=cost, breaks=breaks, reserve=reserve)
    return World(hz, ExecutorSettings(policy_hz=10.0), policy)


def test_a_call_waits_for_its_newest_frame_alone() -> None:
    with seeing() as world:
        world.run(5 * TA)
        policy: Any = world.policy
        assert policy.waited == [ROWS] * len(policy.calls)
        assert len(policy.calls) >= 5
        assert len(policy.early) == len(policy.calls) + (policy.early[-1][0] > policy.calls[-1][0])
        counts = world.executor.statistics()
    assert counts.frames_early == len(policy.early), "no frame is prepared that no call reads"
    assert counts.deadlines_missed == 0
    names = [event["name"] for event in world.executor.trace.to_json()["traceEvents"]]
    assert names.count("frame") == counts.frames_early


def test_between_the_frames_of_a_window_none_is_prepared() -> None:
    with seeing(cost=0.01, hz=50.0) as world:
        world.run(5 * 4 * TA)
        policy: Any = world.policy
    assert set(policy.waited) == {ROWS}
    assert len(policy.early) <= len(policy.calls) + 1


@pytest.mark.parametrize("reserve", [0, 7], ids=["before the actions run out", "as many actions after the last"])
def test_frames_of_a_camera_that_is_faster_than_the_policy_and_not_punctual(reserve: int) -> None:
    rng = np.random.default_rng(0)
    with seeing(cost=0.01, hz=50.0, reserve=reserve) as world:
        world.begin()
        for _ in range(8 * 5 * TA):
            world.observe(world.time - rng.uniform(0, 0.008))
            world.tick(observe=False)
        policy: Any = world.policy
    assert len(policy.calls) >= 8
    assert np.mean(np.array(policy.waited) == ROWS) >= 0.8, "the frames that calls read were others"
    assert len(policy.early) <= 2 * len(policy.calls)


@pytest.mark.parametrize(
    ("wrist", "head", "asked"),
    [
        (ObservationSpec((1, 3, 2, 2), dtype="float64"), ObservationSpec((TO, 3, 2, 2), dtype="float64"), True),
        (ObservationSpec((1, 3, 2, 2), dtype="float64"), None, False),
        (ObservationSpec((3, 2, 2), dtype="float64", window=False), None, False),
    ],
)
def test_cameras_of_another_window_than_the_policys(
    wrist: ObservationSpec, head: ObservationSpec | None, asked: bool
) -> None:
    """The newest picture of each is prepared, as ``select_action`` takes it; none if no call reads older ones."""
    policy = SeeingPolicy(FakeClock(), {"dense": LATENCY}, {})
    own = {**policy.info.observation, "wrist": wrist, **({} if head is None else {"head": head})}
    policy.info = replace(policy.info, observation=own)
    given: list[dict[str, tuple[int, ...]]] = []
    prepare = policy.prepare_frame

    def prepare_frame(frame: Mapping[str, Any], stop: Callable[[], bool]) -> FrameWork:
        given.append({key: Queues(own).after(frame)[key][0].shape for key in own})  # or it would raise
        return prepare(frame, stop)

    policy.prepare_frame = prepare_frame  # type: ignore[method-assign]

    class Seen(World):
        def frame(self, at: float | None = None) -> dict[str, np.ndarray]:
            pictures = {"wrist": np.zeros(wrist.shape), "head": np.zeros((3, 2, 2))}
            return {key: value for key, value in {**super().frame(at), **pictures}.items() if key in own}

    with Seen(10.0, ExecutorSettings(policy_hz=10.0), policy) as world:
        world.run(3 * TA)
        assert len(policy.calls) >= 2
    assert bool(given) is asked
    assert all(one["wrist"] == one["head"] == (1, 3, 2, 2) for one in given)


def test_a_call_that_is_due_is_not_kept_waiting_by_what_is_left() -> None:
    with seeing(cost=0.18) as world:  # longer than a period: the second piece of a frame is left to the call
        world.begin()
        for _ in range(4 * TA):
            world.tick(action=False)
        policy: Any = world.policy
        newest = [obs[0, -1, 1] for _, _, obs in policy.calls]
        begun = policy.begun[: len(newest)]  # another call may be under way
        late = [start - world.start - seen for start, seen in zip(begun, newest, strict=True)]
    assert max(late) <= 0.18 / ROWS + 1e-6, "one piece of work is the most that a call waits for"
    assert ROWS + 1 in policy.waited, "the second piece was left to the call"


def test_a_frame_that_another_takes_the_place_of_is_left() -> None:
    with seeing(cost=0.1) as world:
        world.observe()
        at = world.time
        world.clock.advance(0.02)  # the first piece of the frame is under way
        world.executor.observe({"obs": np.array([7.0, 7.0])}, world.start + at)
        world.clock.settle()
        world.clock.advance(0.08)
        world.tick(action=False)
        world.executor.action(timeout=5.0)
        policy: Any = world.policy
        (content, other) = (policy.early[0][1], policy.early[1][1])
        assert (1, content) not in policy.known, "its second piece was of no use any more"
        assert other == np.array([7.0, 7.0]).tobytes()
        assert policy.calls[0][2][0, 0].tolist() == [7.0, 7.0], "the call reads the frame that took its place"


@pytest.mark.parametrize("breaks", [0, 1, 5])
def test_what_fails_is_told_and_no_action_comes_of_it(breaks: int) -> None:
    world = seeing(breaks=breaks)
    with pytest.raises(WorkerDeadError) as raised, world:
        world.run(3 * TA)
    assert isinstance(raised.value.__cause__, ZeroDivisionError)


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["frame", "none", "twice", "late", "again", "still", "reset"]),
        st.floats(0, 0.09),
        st.booleans(),
    ),
    min_size=10,
    max_size=60,
)


def play(world: World, events: list[tuple[str, float, bool]]) -> tuple[list[Any], list[Any]]:
    """What came out of the ticks, and the calls."""
    made: list[Any] = []
    given: set[bytes] = set()
    still = np.array([0.0, 0.0])

    def observe(value: np.ndarray, at: float) -> None:
        given.add(value.tobytes())
        world.executor.observe({"obs": value}, world.start + at)
        world.clock.settle()

    for what, shift, act in events:
        now = world.time
        if what == "reset":
            world.executor.reset()
            world.clock.settle()
        elif what == "late":
            observe(np.array([world.episode, max(now - shift, 0.0)], np.float64), max(now - shift, 0.0))
        elif what == "still":  # a camera that stopped: the picture of before, with a new time
            observe(still, now)
        elif what != "none":
            still = np.array([world.episode, now], np.float64)
            for _ in range(2 if what == "twice" else 1):
                observe(still, now)
            if what == "again":  # the same time, another picture
                observe(still + 100, now)
        if act:
            try:
                made.append(world.executor.action().tolist())
            except ExecutorError as error:
                made.append(type(error).__name__)
        world.clock.advance(0.1)
    calls = [(start - world.start, obs.tolist()) for start, _, obs in world.policy.calls]
    for _, obs in calls:
        assert all(np.array(frame).tobytes() in given for frame in obs[0]), "a frame that nobody gave"
    assert all(content in given for _, content in getattr(world.policy, "early", []))
    return made, calls


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(EVENTS)
def test_preparing_frames_changes_no_call_and_no_action(events: list[tuple[str, float, bool]]) -> None:
    with World(10.0, ExecutorSettings(policy_hz=10.0)) as plain:
        expected = play(plain, events)
    with seeing(cost=0.0) as world:
        assert play(world, events) == expected


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(EVENTS)
def test_frames_that_take_their_time_delay_a_call_by_one_piece_at_most(events: list[tuple[str, float, bool]]) -> None:
    with World(10.0, ExecutorSettings(policy_hz=10.0)) as plain:
        _, expected = play(plain, events)
    with seeing() as world:
        play(world, events)
        policy: Any = world.policy
    assert all(1 <= n <= 2 * ROWS or n == 0 for n in policy.waited)
    if expected and policy.calls:
        assert policy.begun[0] - world.start <= expected[0][0] + COST / ROWS + 1e-6
