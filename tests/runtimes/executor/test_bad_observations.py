"""The fault drill, observations: they stop, come late, out of order, or are wrong."""

import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ttscompile import Affine, ChunkSpec, ObservationSpec
from ttscompile.core.poses import Pose
from ttscompile.core.spec import Relative
from ttscompile.core.values import check_values
from ttscompile.errors import ExecutorError, ObservationError, StaleObservationError
from ttscompile.runtimes.executor import ExecutorSettings
from ttscompile.runtimes.executor.window import FrameSpec

from .simulation import AS_IT_IS, TA, TO, FakeClock, ScriptedPolicy, World


def test_observations_that_stop_end_in_a_stale_observation() -> None:
    with World(settings=ExecutorSettings(max_hold=2)) as world:
        world.begin()
        made = []
        with pytest.raises(StaleObservationError, match=r"window is 1\.1 s old, and may be 0\.3 s"):  # noqa: PT012
            for _ in range(100):
                made.append(world.tick(observe=False))
        assert len(made) == TA - 1 + 2  # what was left of the one chunk, and the holds
        assert len(world.policy.calls) == 1


def test_frames_that_are_too_old_start_no_call() -> None:
    with World(settings=ExecutorSettings(max_age=0.2)) as world:
        world.clock.advance(1.0)
        world.observe(at=0.68)
        world.observe(at=0.75)
        assert world.policy.calls == []
        with pytest.raises(
            StaleObservationError, match=r"newest complete observation window is 0\.25 s old, and may be 0\.2 s"
        ):
            world.executor.action()
        world.observe(at=0.9)
        world.observe(at=1.0)
        assert len(world.policy.calls) == 1


def test_late_frames_and_frames_out_of_order_still_make_windows() -> None:
    with World() as world:
        world.begin()
        order = random.Random(0)
        delayed: list[float] = []
        for _ in range(100):
            delayed.append(world.time)
            if len(delayed) == 2:
                order.shuffle(delayed)
                for at in delayed:
                    world.observe(at)
                delayed.clear()
            assert world.tick(observe=False) is not None
        for _, _, obs in world.policy.calls:
            assert obs[0, 1, 1] - obs[0, 0, 1] == pytest.approx(0.1)
        counted = world.executor.statistics()
    assert counted.starved == 0
    assert counted.frames == 102


def test_a_frame_that_comes_far_too_late_is_counted_and_left_out() -> None:
    with World() as world:
        world.run(30)
        world.observe(at=0.5)
        assert world.executor.statistics().frames_late == 1


def test_wrong_frames_are_the_callers_error_and_change_nothing() -> None:
    with World() as world:
        world.begin()
        for obs in (
            {"obs": np.zeros(3)},
            {"obs": np.array([0.0, np.nan])},
            {"image": np.zeros(2)},
            {"obs": np.zeros(2, int)},
            {"obs": np.ma.masked_array(np.zeros(2), mask=[True, False])},
            {"obs": np.array([0.0, 1e30])},
            {"obs": [0.0, 0.0]},
        ):
            with pytest.raises(ObservationError):
                world.executor.observe(obs)
        with pytest.raises(ObservationError, match="5 s ahead of the executor's clock"):
            world.executor.observe(world.frame(), world.clock.now() + 5)
        with pytest.raises(ObservationError):
            world.executor.observe(world.frame(), float("nan"))
        for _ in range(20):
            assert world.tick() is not None
        assert world.executor.statistics().frames == 22


@pytest.mark.parametrize("history", [True, False])
def test_a_measured_pose_without_a_rotation_is_the_callers_error_and_changes_nothing(history: bool) -> None:
    """A detector that lost the arm gives zeros: as the newest of a call they would end the policy's thread."""

    class Arm(ScriptedPolicy):
        def predict_action(self, obs_dict: Any, *, plan: str) -> dict[str, Any]:
            self.info.action.reference(obs_dict)  # as a compiled policy does
            return {"action_pred": np.zeros((1, self.predicted, 10))}

    policy = Arm(FakeClock(), also=AS_IT_IS)
    action = ChunkSpec(10, TO - 1, TO - 1 + TA, relative=Relative("obs", (None,) * 10, (Pose(1, 0),)))
    specs = policy.info.observation if history else {"obs": ObservationSpec((9,), dtype="float64", window=False)}
    policy.info = replace(policy.info, action=action, sample=(policy.predicted, 10), observation=specs)
    with World(policy=policy) as world:
        world.begin()
        for _ in range(3 * TA):
            with pytest.raises(ObservationError, match="numbers 3 to 8 are to be two rows of a rotation.* which gives"):
                world.executor.observe({"obs": np.zeros(9)})
            world.tick()
        counted = world.executor.statistics()
    assert (counted.frames, counted.deadlines_missed) == ((TO if history else 2) + 3 * TA, 0)


def test_a_frame_is_held_against_what_the_policy_takes_before_it_is_kept() -> None:
    """What a call would refuse ends the policy's thread, so it has to be refused here."""
    image = ObservationSpec((2, 3, 4, 4), bounds=(0.0, 1.0))
    tokens = ObservationSpec((4,), dtype="int64", window=False, bounds=(0.0, 9.0))
    state = ObservationSpec((2, 1), Affine(np.array([2.0]), np.array([0.0])))
    frames = FrameSpec.of({"image": image, "tokens": tokens, "state": state}, 2)
    good: dict[str, Any] = {"image": np.ones((3, 4, 4), "f4"), "tokens": np.arange(4), "state": np.ones(1, "f4")}
    assert frames.check(good).keys() == good.keys()
    for key, values, message in (
        ("image", good["image"] * 255, r"'image' is an image .* of 0 to 1; found 255 to 255\. Divide by 255"),
        ("tokens", good["tokens"] + 7, "'tokens' must hold integers of 0 to 9; found 7 to 10"),
        ("state", good["state"] * np.float32(6e5), r"1e\+06 when normalised; found 600000 at index \(0,\) \(1\.2e\+06"),
    ):
        with pytest.raises(ObservationError, match=message):
            frames.check(good | {key: values})


def test_a_frame_is_copied_before_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    given = np.array([1.0, 2.0], np.float32)

    def spoiled(array: np.ndarray, *others: Any) -> None:
        given[:] = np.nan
        check_values(array, *others)

    monkeypatch.setattr("ttscompile.runtimes.executor.window.check_values", spoiled)
    assert FrameSpec.of({"obs": ObservationSpec((2,))}, 1).check({"obs": given})["obs"].tolist() == [1, 2]


@pytest.mark.parametrize("wrong", ["x", [1.0], {}, 1j, np.zeros(2)])
def test_times_are_numbers(wrong: Any) -> None:
    with World() as world:
        world.begin()
        with pytest.raises(ExecutorError, match="t is a number of seconds"):
            world.executor.observe({"obs": np.zeros(2)}, wrong)
        with pytest.raises(ExecutorError, match="t is a number of seconds"):
            world.executor.action(wrong)
        with pytest.raises(ExecutorError, match="timeout is a number of seconds"):
            world.executor.action(None, wrong)
        world.tick()
        now: Any = np.float32(world.clock.now())
        world.executor.action(now)
