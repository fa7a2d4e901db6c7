"""Actions that say how far to move: what is overdue is made up for, and a held action moves nothing."""

import numpy as np
import pytest

from ttscompile.errors import DeadlineMissedError, ExecutorError
from ttscompile.runtimes.executor import ExecutorSettings, GuardLimits

from .simulation import TA, TO, FakeClock, ScriptedPolicy, World

GOAL, RESERVE = 1.0, 8


class Robot(World):
    """A robot at ``place``, and a policy that is at the goal after its first action: one that corrects at once.

    Channel 0 is displaced by that, channel 1 is told where the goal is, channel 2 counts.
    """

    def __init__(self, settings: ExecutorSettings, latency: float = 0.1) -> None:
        self.place = 0.0
        policy = ScriptedPolicy(FakeClock(), {"dense": latency}, actions=self.answer, reserve=RESERVE)
        super().__init__(settings=settings, policy=policy)

    def answer(self, obs: np.ndarray) -> np.ndarray:
        chunk = np.zeros((TO - 1 + TA + RESERVE, 3))
        chunk[TO - 1, 0] = GOAL - obs[-1, 0]
        chunk[:, 1], chunk[:, 2] = GOAL, np.arange(len(chunk))
        return chunk

    def frame(self, at: float | None = None) -> dict[str, np.ndarray]:
        return {"obs": np.array([self.place, self.time if at is None else at])}

    def drive(self, ticks: int) -> list[np.ndarray]:
        made = []
        for _ in range(ticks):
            self.observe()
            try:
                made.append(self.executor.action())
                self.place += float(made[-1][0])
            except DeadlineMissedError:
                pass
            self.clock.advance(1 / self.hz)
        return made


def settings(**given: object) -> ExecutorSettings:
    return ExecutorSettings(refuse_infeasible=False, displacements=(0,), **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("latency", [0.05, 0.1, 0.3])
@pytest.mark.parametrize("seam", ["replace", "blend", "ensemble"])
def test_a_push_is_corrected_however_late_the_chunk_comes(seam: str, latency: float) -> None:
    with Robot(settings(seam=seam), latency) as robot:
        robot.drive(20)
        assert robot.place == pytest.approx(GOAL, abs=1e-6), "it got there with the first chunk"
        robot.place += 0.5
        made = robot.drive(6 * TA)
        assert robot.place == pytest.approx(GOAL, abs=0.05 if seam == "ensemble" else 1e-6)
        assert all(action[1] == GOAL for action in made), "positions are as they were"


def test_a_push_stays_where_displacements_are_taken_for_positions() -> None:
    with Robot(ExecutorSettings()) as robot:
        robot.drive(20)
        robot.place += 0.5
        robot.drive(6 * TA)
        assert robot.place == pytest.approx(GOAL + 0.5, abs=1e-6), "only a first action corrects, and that is overdue"


def test_it_is_made_up_for_within_the_bounds_of_the_guard() -> None:
    with Robot(settings(guard=GuardLimits(low=-0.2, high=[1.0, 2.0, 99.0], clip=True))) as robot:
        robot.drive(20)
        robot.place += 0.5
        made = np.array(robot.drive(2 * TA))[:, 0]
        assert robot.place == pytest.approx(GOAL, abs=1e-6)
        assert made.min() == pytest.approx(-0.2)
        assert np.count_nonzero(np.abs(made) > 1e-6) == 3


def test_blend_makes_up_for_it_evenly() -> None:
    with Robot(settings(seam="blend", blend_steps=5)) as robot:
        robot.drive(20)
        robot.place += 0.5
        made = np.array(robot.drive(2 * TA))[:, 0]
        assert made[np.abs(made) > 1e-6] == pytest.approx([-0.1] * 5)


def test_a_held_action_moves_nothing_and_still_says_where_to_be() -> None:
    with Robot(settings(max_hold=2, reserve=0)) as robot:
        robot.drive(20)
        robot.policy.fault[len(robot.policy.calls)] = "hang"
        robot.executor.observe(robot.frame())
        held = []
        for _ in range(3 * TA):
            before = robot.executor.statistics().holds
            robot.observe()
            try:
                action = robot.executor.action()
            except DeadlineMissedError:
                break
            if robot.executor.statistics().holds > before:
                held.append(action)
            robot.clock.advance(1 / robot.hz)
    assert [action[0] for action in held] == [0, 0]
    assert [action[1] for action in held] == [GOAL, GOAL]


@pytest.mark.parametrize(
    ("wrong", "told"), [((3,), "channels, 0 to 2"), ((-1,), "displacements"), ((0.5,), "an integer"), (0, "a tuple")]
)
def test_channels_that_are_not_there(wrong: tuple[float, ...], told: str) -> None:
    with pytest.raises(ExecutorError, match=told):
        Robot(ExecutorSettings(displacements=wrong))  # type: ignore[arg-type]


def test_a_robot_that_keeps_moving_evenly_has_not_stopped() -> None:
    """Displacements that are all the same say that it moves; positions that are, that it stands."""
    made = {"tiers": ("dense",), "stall_after": 1.0, "stall_range": 0.05}
    for channels, stalls in (((), 1), ((0,), 0)):
        robot = Robot(ExecutorSettings(refuse_infeasible=False, displacements=channels, **made))  # type: ignore[arg-type]
        with robot:
            robot.policy.actions = lambda obs: np.tile([0.1, GOAL, 0.0], (TO - 1 + TA + RESERVE, 1))
            robot.drive(30)
            assert (robot.executor.statistics().stalls > 0) == bool(stalls)
            robot.policy.actions = lambda obs: np.tile([0.0, GOAL, 0.0], (TO - 1 + TA + RESERVE, 1))
            robot.drive(40)
            assert robot.executor.statistics().stalls > 0
