"""``GuardLimits(clip=True)``: what is given out keeps the limits, whatever the policy says."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ttscompile.errors import DeadlineMissedError, ExecutorError
from ttscompile.runtimes.executor import ExecutorSettings, ExecutorStatistics, GuardLimits
from ttscompile.runtimes.executor.guard import Guard

from .simulation import NORMALIZER, FakeClock, ScriptedPolicy, World, rows

NOTHING = np.empty((0, 2), np.float32)


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 3),
    st.integers(1, 30),
    st.floats(1e-3, 10),
    st.sampled_from([1, 1e3, 1e-3]),
)
def test_a_schedule_is_brought_within_the_limits_and_no_further(
    seed: int, played: int, length: int, step: float, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    limits = GuardLimits(low=-3 * scale, high=2.5 * scale, max_step=[step * scale, 0.7 * scale], clip=True)
    guard = Guard(limits, None, 2)
    low, high = np.float32(-3 * scale), np.float32(2.5 * scale)
    most = np.array([step * scale, 0.7 * scale], np.float32).astype(np.float64)
    past = rng.uniform(low, high, (played, 2)).astype(np.float32)
    wanted = (rng.normal(0, 2, (length, 2)) * scale).astype(np.float32)
    made = guard.limited(past, wanted)
    assert made.dtype == np.float32 and made.shape == wanted.shape
    assert (made >= low).all() and (made <= high).all()
    joined = np.concatenate([past[-1:], made]).astype(np.float64)
    assert (np.abs(np.diff(joined, axis=0)) <= most).all()
    np.testing.assert_array_equal(guard.limited(past, made), made)  # what keeps the limits stays as it is
    before = past[-1] if played else None
    for action, expected in zip(made, wanted, strict=True):
        nearest = np.clip(expected, low, high)
        nearest = nearest if before is None else np.clip(nearest, before - most, before + most)
        np.testing.assert_allclose(action, nearest, atol=2e-6 * scale)
        before = action
    assert guard.refuse(wanted) is None
    assert guard.refuse_motion(past, made) is None


def test_bounds_come_from_the_normaliser_as_they_do_for_refusing() -> None:
    guard = Guard(GuardLimits(margin=0.1, clip=True), NORMALIZER, 2)
    np.testing.assert_allclose(
        guard.limited(NOTHING, rows((-9, 99), (1, 1), (9, -99))), [(-2.4, 22), (1, 1), (2.4, -2)]
    )
    assert guard.refuse(rows((-9, 99))) is None
    assert Guard(GuardLimits(margin=0.1), NORMALIZER, 2).refuse(rows((-9, 99))) is not None


def test_what_is_no_number_and_what_jerks_are_refused_all_the_same() -> None:
    guard = Guard(GuardLimits(max_step=9.0, max_jerk=1.0, clip=True), NORMALIZER, 2)
    for bad in (np.nan, np.inf, -np.inf):
        assert guard.refuse(rows((0, 5), (bad, 5))) == "1 of its 4 numbers are not finite"
    assert "its jerk of 3 in channel 1" in str(guard.refuse_motion(NOTHING, rows((0, 0), (0, 1), (0, 0), (0, 0))))


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"clip": 1}, "clip must be True or False; found 1"),
        ({"clip": "no"}, "clip must be True or False; found 'no'"),
        ({"clip": True}, "clip has nothing to clip to: the normaliser of the actions has no range. Give low and high"),
        ({"clip": True, "max_jerk": 1.0}, "clip has nothing to clip to"),
    ],
)
def test_clip_is_checked(limits: dict[str, object], message: str) -> None:
    with pytest.raises(ExecutorError, match=message):
        Guard(GuardLimits(**limits), None, 2)  # type: ignore[arg-type]
    Guard(GuardLimits(clip=True, max_step=1.0), None, 2)
    Guard(GuardLimits(clip=True, low=[0.0, -np.inf]), None, 2)


def wild(seed: int, scale: float, **changed: object) -> tuple[list[np.ndarray | None], ExecutorStatistics]:
    """What 50 ticks give out of a policy that walks at random, and whose calls are late now and then; None: nothing."""
    rng = np.random.default_rng(seed)
    faults: dict[int, str | float] = {int(call): float(rng.choice([0.9, 1.4])) for call in rng.integers(1, 9, 2)}
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.1}, faults, reserve=3)
    policy.actions = lambda _: np.cumsum(rng.normal(0, scale, (policy.predicted, 3)), axis=0).astype(np.float32)
    guard = GuardLimits(low=-1.5, high=[1.0, 2.0, 3.0], max_step=[0.25, 0.5, 9.0], clip=True)
    given_out: list[np.ndarray | None] = []
    with World(20.0, ExecutorSettings(policy_hz=10.0, guard=guard, max_hold=2, **changed), policy) as world:  # type: ignore[arg-type]
        world.begin()
        for _ in range(50):
            try:
                given_out.append(world.executor.action())
            except DeadlineMissedError:
                given_out.append(None)
            world.clock.advance(1 / world.hz)
            world.observe()
        return given_out, world.executor.statistics()


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    seam=st.sampled_from(["replace", "blend", "ensemble"]),
    interpolation=st.sampled_from(["hold", "linear"]),
    horizon=st.sampled_from([2, 8]),
)
def test_nothing_that_is_given_out_exceeds_the_limits(seed: int, seam: str, interpolation: str, horizon: int) -> None:
    """At seams, after holds, and after ticks for which there was nothing."""
    made, counted = wild(seed, 1.0, seam=seam, interpolation=interpolation, horizon=horizon, refuse_infeasible=False)
    played = np.stack([each for each in made if each is not None]).astype(np.float64)
    assert (played >= -1.5).all() and (played <= [1.0, 2.0, 3.0]).all()
    assert (np.abs(np.diff(played, axis=0)) <= [0.25, 0.5, 9.0]).all()
    assert counted.chunks_refused == 0
    assert 0 < counted.actions_clipped <= counted.ticks


def test_the_loop_goes_on_within_the_limits_after_a_hold_and_after_it_starved() -> None:
    """Every call answers for another place; one comes when the last action was held for as long as it may be."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.1}, {2: 1.6})
    policy.actions = lambda _: np.full((policy.predicted, 3), 4.0 * (len(policy.calls) % 2))
    guard = GuardLimits(low=-5.0, high=5.0, max_step=1.0, clip=True)
    made: list[float] = []
    with World(settings=ExecutorSettings(guard=guard, max_hold=2), policy=policy) as world:
        world.begin()
        for _ in range(40):
            try:
                made.append(float(world.tick()[0]))
            except DeadlineMissedError:
                world.clock.advance(0.1)
        counted = world.executor.statistics()
    assert counted.holds == 2 and counted.starved > 0
    assert set(np.abs(np.diff(made)).round(5)) == {0.0, 1.0}  # as fast as it may, and no faster
    assert {0.0, 4.0} <= set(made)


def test_what_was_changed_is_counted_when_it_is_given_out() -> None:
    """Two actions of a chunk are out of bounds when they are played, three of the first, which begins at its beginning.

    Without a clip no chunk would be played.
    """
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.02}, reserve=4)
    policy.actions = lambda _: np.where(np.arange(policy.predicted)[:, None] < 4, 7.0, np.full((1, 3), 0.5))
    for clip, clipped in ((True, 21), (False, 0)):
        policy.clock, policy.calls = FakeClock(), []
        guard = GuardLimits(low=-1.0, high=1.0, clip=clip)
        with World(settings=ExecutorSettings(guard=guard), policy=policy) as world:
            for _ in range(2):
                world.tick(action=False)
            world.observe()
            made = []
            for _ in range(80):
                try:
                    made.append(world.tick())
                except DeadlineMissedError:
                    world.clock.advance(0.1)
            counted = world.executor.statistics()
        assert counted.actions_clipped == clipped
        assert (counted.chunks_refused == 0) == clip
        assert {float(action[0]) for action in made} == ({0.5, 1.0} if clip else set())
