"""Where an episode begins: until the first action is given out, the robot is where it was seen."""

import pytest

from ttscompile.errors import StaleObservationError
from ttscompile.runtimes.executor import ExecutorSettings

from .simulation import TA, FakeClock, Told, World


@pytest.mark.parametrize("seam", ["replace", "prefix"])
@pytest.mark.parametrize("stood", range(3, 2 * TA))
def test_what_was_seen_before_the_first_action_begins_with_it(stood: int, seam: str) -> None:
    """However long the robot stands, and whether or not a call is under way when it begins."""
    policy = Told(FakeClock(), {"dense": 0.3}, reserve=TA)
    with World(settings=ExecutorSettings(seam=seam), policy=policy) as world:
        for _ in range(stood + 1):
            world.tick(action=False)
        begun = world.time
        made = [world.tick() for _ in range(3 * TA)]
        before = [(prefix, obs) for prefix, (_, _, obs) in zip(policy.prefixes, policy.calls, strict=False)]
        assert world.executor.statistics().deadlines_missed == 0
    early = [action for action in made if action[1] < begun - 0.01]
    assert [action[2] for action in early] == list(range(len(early)))
    assert len(early) >= 3
    for action, number in zip(made[len(early) :], range(len(early), len(made)), strict=True):
        assert action[1] + action[2] / 10 == pytest.approx(begun + number / 10, abs=1e-3)
    if seam == "prefix":
        told = [prefix for prefix, obs in before if obs[0, -1, 1] < begun - 0.01]
        assert all((prefix[:, 2] == range(len(prefix))).all() for prefix in told)
        assert [len(prefix) for prefix in told] == [0, *[4] * (len(told) - 1)]


@pytest.mark.parametrize("seam", ["replace", "blend", "ensemble"])
@pytest.mark.parametrize("stood", range(3, 3 * TA))
def test_no_mean_is_made_with_a_chunk_of_which_nothing_was_played(stood: int, seam: str) -> None:
    with World(settings=ExecutorSettings(seam=seam)) as world:
        for _ in range(stood):
            world.tick(action=False)
        made = [world.tick() for _ in range(2)]
    assert [action[2] for action in made] == [0, 1]


def test_a_first_chunk_that_would_be_over_is_not_played() -> None:
    """Its last action is for 0.8 s: a tick earlier it would still be begun at its beginning."""
    for waited, index in ((TA - 1, 0.0), (TA, None)):
        with World() as world:
            world.tick(action=False)
            world.observe()
            world.clock.advance(waited / world.hz)
            if index is None:
                with pytest.raises(StaleObservationError, match="is 0.8 s old"):
                    world.executor.action()
            else:
                assert [world.tick(observe=False)[2] for _ in range(TA)] == list(range(TA))
