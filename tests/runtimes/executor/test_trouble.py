"""``trouble``: why no action comes, where none will."""

import re

import numpy as np
import pytest

from ttscompile.errors import StaleObservationError
from ttscompile.runtimes.executor import ExecutorSettings, GuardLimits

from .simulation import FakeClock, ScriptedPolicy, World


def test_frames_at_another_rate_than_the_policys_are_a_trouble_until_one_fits() -> None:
    """The rate of the policy was left out, and the camera gives 30 frames a second."""
    with World(hz=50.0, latency={"dense": 0.01}) as world:
        for number in range(10):
            assert (world.executor.trouble == "") is (number < 2)
            world.observe()
            assert not world.executor.ready
            world.clock.advance(1 / 30)
        assert "the policy wants 2 frames every 0.02 s, to within 0.006 s; the newest came 0.03333" in (
            world.executor.trouble
        )
        world.observe(world.time - 1 / 30 + 0.02)
        assert world.executor.trouble == ""
    assert world.executor.trouble == "the executor was closed"


@pytest.mark.parametrize(
    ("ago", "told"),
    [
        (0.4, r"the newest complete observation window is 0\.4 s old, and may be 0\.3 s"),
        (
            100.0,
            r"were thrown away, 30 in a row; the last one 100 s after it was taken, and 0\.43 s is the most. Stamp",
        ),
    ],
)
def test_frames_that_are_always_too_old_are_a_trouble_until_one_is_not(ago: float, told: str) -> None:
    """They take long to come, or are stamped by a clock that is behind."""
    with World() as world:
        for number in range(30):
            world.clock.advance(0.1)
            world.executor.observe(world.frame(), world.clock.now() - ago)
            assert (world.executor.trouble == "") is (number < (2 if ago > 1 else 1))
        assert re.search(told, world.executor.trouble)
        with pytest.raises(StaleObservationError, match=told):
            world.executor.action()
        assert not world.executor.ready
        world.begin()
        assert (world.executor.trouble, world.executor.ready) == ("", True)


@pytest.mark.parametrize("wrong", ["refused", "overdue"])
def test_chunks_that_come_to_nothing_are_a_trouble_until_one_does_not(wrong: str) -> None:
    """The guard refuses every one, or they are over when they come."""
    policy = ScriptedPolicy(FakeClock(), {"dense": 0.1 if wrong == "refused" else 1.5})
    policy.actions = lambda obs: np.full((policy.predicted, 3), 5.0 * (obs[-1, 1] < 3))
    guard = GuardLimits(high=1.0 if wrong == "refused" else 9.0)
    with World(settings=ExecutorSettings(guard=guard, refuse_infeasible=False), policy=policy) as world:
        while world.executor.statistics().calls < 1:
            assert world.executor.trouble == ""
            world.tick(action=False)
        for _ in range(8):
            told = "the guard refused the last chunk: action 0" if wrong == "refused" else "ones took 1.5 s"
            assert told in world.executor.trouble
            world.tick(action=False)
        policy.latency["dense"] = 0.1
        while not world.executor.ready:
            assert world.time < 5
            world.tick(action=False)
        assert world.executor.trouble == ""
        world.executor.reset()
        assert world.executor.trouble == ""
