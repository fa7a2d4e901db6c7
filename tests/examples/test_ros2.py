"""The ROS 2 node on a stand-in for rclpy: not on ROS 2, which is not here."""

import sys
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.once import Once
from tests.runtimes.executor.simulation import TO, FakeClock, ScriptedPolicy, workers
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile import ObservationSpec
from ttscompile.errors import ObservationError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings

from . import rclpy_stand_in as ros
from .recipes import script

FOLDER = Path(__file__).parents[2] / "examples" / "ros2"
HZ = 10.0
TOPIC = "~/observation/obs"


@pytest.fixture
def node_module() -> Iterator[ModuleType]:
    with ros.installed(spin=lambda node: None):
        yield script(FOLDER, "policy_node")


class Robot:
    """A node over a scripted policy, in a world without real time."""

    def __init__(self, module: ModuleType, fault: dict[int, str | float], goal: bool, **overrides: Any) -> None:
        self.clock = FakeClock()
        self.policy = ScriptedPolicy(self.clock, fault=fault)
        if goal:
            observed = {"goal": ObservationSpec((2,)), **self.policy.info.observation}
            self.policy.info = replace(self.policy.info, observation=observed)
        ros.Node.seconds = staticmethod(self.clock.now)
        ros.Node.overrides = {"control_hz": HZ, **overrides}

        def opened(given: dict[str, Any]) -> AsyncExecutor:
            settings = ExecutorSettings(max_hold=0, reserve=0, refuse_infeasible=False)
            return AsyncExecutor(
                self.policy, given["control_hz"], settings, clock=self.clock, latencies=self.policy.latency
            )

        self.node = module.PolicyNode(opened)
        self.clock.settle()

    def observe(self, number: float = 0.0) -> None:
        self.node.deliver(TOPIC, ros.Float64MultiArray(array("d", [0.0, number])))
        self.clock.settle()

    def tick(self, observed: bool = True) -> None:
        """A message, the timer of the control loop, and time goes on."""
        if observed:
            self.observe()
        period, callback = self.node.made_timers[0]
        callback()
        self.clock.advance(period)

    @property
    def commands(self) -> list[Any]:
        return self.node.made_publishers["~/commands"].published

    def diagnosis(self) -> tuple[bytes, dict[str, str]]:
        period, callback = self.node.made_timers[1]
        assert period == 1.0
        callback()
        (status,) = self.node.made_publishers["/diagnostics"].published[-1].status
        return status.level, {"message": status.message} | {each.key: each.value for each in status.values}


@contextmanager
def robot(
    module: ModuleType, fault: dict[int, str | float] | None = None, goal: bool = False, **overrides: Any
) -> Iterator[Robot]:
    made = Robot(module, fault or {}, goal, **overrides)
    try:
        yield made
    finally:
        made.clock.free()
        made.policy.release()
        made.node.destroy_node()
        assert made.node.destroyed
        assert workers() == []


def test_observations_come_in_and_commands_go_out(node_module: ModuleType) -> None:
    with robot(node_module) as one:
        one.tick()
        assert one.commands == [], "one frame is no window"
        for _ in range(20):
            one.tick()
        assert len(one.commands) >= 18
        assert [command.data[2] for command in one.commands[:3]] == sorted(
            command.data[2] for command in one.commands[:3]
        )
        level, told = one.diagnosis()
        assert level == b"\x00"
        assert told["message"] == "on time"
        assert told["deadlines_missed"] == "0"
        assert float(told["latency_ms p50"]) == pytest.approx(100)


def test_a_robot_without_action_is_an_error_and_nothing_is_sent(node_module: ModuleType) -> None:
    with robot(node_module) as one:
        for _ in range(5):
            one.tick()
        for _ in range(30):  # the camera is gone
            one.tick(observed=False)
        sent = len(one.commands)
        one.tick(observed=False)
        assert len(one.commands) == sent
        level, told = one.diagnosis()
        assert level == b"\x02"
        assert int(told["starved"]) > 0
        assert "observation" in told["message"]
        assert one.diagnosis()[1]["starved"] == "0", "each is told once"


def test_a_late_chunk_is_a_warning(node_module: ModuleType) -> None:
    with robot(node_module, fault={2: "nan"}) as one:
        for _ in range(14):
            one.tick()
        level, told = one.diagnosis()
        assert (level, told["chunks_refused"]) in [(b"\x01", "1"), (b"\x02", "1")]


def test_frames_that_make_no_window_are_a_warning(node_module: ModuleType) -> None:
    with robot(node_module) as one:
        assert one.diagnosis()[1]["message"] == "waiting for obs"
        for _ in range(5):  # half as many a second as the policy wants
            one.tick()
            one.tick(observed=False)
        level, told = one.diagnosis()
        assert level == b"\x01"
        assert "the policy wants 2 frames every 0.1 s" in told["message"]


def test_a_message_that_does_not_fit_is_refused_and_told(node_module: ModuleType) -> None:
    with robot(node_module) as one:
        one.node.deliver(TOPIC, ros.Float64MultiArray(array("d", [1.0])))
        one.observe(float("nan"))
        assert len(one.node.get_logger().warnings) == 2
        level, told = one.diagnosis()
        assert level == b"\x01"
        assert told["refused"] == "2"
        assert one.node._executor.statistics().frames == 0


def test_a_reset_begins_an_episode(node_module: ModuleType) -> None:
    with robot(node_module) as one:
        for _ in range(10):
            one.tick()
        response = one.node.made_services["~/reset"](ros.Trigger.Request(), ros.Trigger.Response())
        assert response.success
        sent = len(one.commands)
        one.tick()
        assert len(one.commands) == sent, "nothing of the episode before is played"
        for _ in range(TO + 3):
            one.tick()
        assert len(one.commands) > sent
        assert one.policy.resets


def test_a_goal_that_is_published_once_lasts(node_module: ModuleType) -> None:
    """Also if it was published before the node started, a minute ago, or before a reset."""
    with robot(node_module, goal=True) as one:
        assert one.node.made_qualities == {
            "~/observation/goal": ros.QoSProfile(1, "transient local", "reliable"),
            TOPIC: ros.SENSOR_DATA,
        }
        assert one.diagnosis()[1]["message"] == "waiting for goal, obs"
        for _ in range(5):
            one.tick()
        assert "waiting for goal" in one.diagnosis()[1]["message"]
        one.node.deliver("~/observation/goal", ros.Float64MultiArray(array("d", [1.0, 2.0])))
        one.clock.advance(60.0)
        for _ in range(2):
            for _ in range(TO + 4):
                one.tick()
            assert one.diagnosis()[1]["message"] == "on time"
            one.node.made_services["~/reset"](ros.Trigger.Request(), ros.Trigger.Response())
            assert one.diagnosis()[1]["message"] == "waiting for obs"
        assert one.commands


def test_which_observations_last_can_be_said(node_module: ModuleType) -> None:
    """A number without a window may be measured anew for every frame, and complete it."""
    for said in ({"goal_keys": ["obs"]}, {"frame_key": "goal"}):
        with robot(node_module, goal=True, **said) as one:
            assert one.node._frame_key == "goal"
            assert one.node.made_qualities["~/observation/goal"] == ros.SENSOR_DATA
            assert (one.node.made_qualities[TOPIC] == ros.SENSOR_DATA) == ("frame_key" in said)
    for goals, why in (
        (["aim"], r"goal_keys is 'aim'; the policy observes \['goal', 'obs'\]"),
        (["goal", "obs"], "frame_key"),
    ):
        with pytest.raises(ObservationError, match=why):
            Robot(node_module, {}, goal=True, goal_keys=goals)


def test_a_stamp_of_ros_is_the_same_moment_on_the_executors_clock(node_module: ModuleType) -> None:
    with robot(node_module) as one:
        now = one.node.get_clock().now().nanoseconds
        stamp = ros.Time(now - 250_000_000).to_msg()
        assert one.node._taken(ros.JointState(ros.Header(stamp))) == pytest.approx(one.clock.now() - 0.25, abs=1e-6)
        assert one.node._taken(ros.JointState()) == one.clock.now(), "a stamp of zero is none"
        assert one.node._taken(ros.Float64MultiArray()) == one.clock.now()


def test_joints_come_in_any_order_and_pictures_as_rows_of_bytes(node_module: ModuleType) -> None:
    state = ros.JointState(name=["wrist", "elbow", "gripper"], position=array("d", [1.0, 2.0, 3.0]))
    assert node_module.from_joints(state, ["elbow", "wrist"], "float32").tolist() == [2.0, 1.0]
    with pytest.raises(ObservationError, match=r"joints \['hip'\] are not in the message"):
        node_module.from_joints(state, ["hip"], "float32")
    rows = bytes([0, 51, 102, 153, 204, 255, 9, 9])  # two pixels, and two bytes that belong to none
    picture = node_module.from_picture(
        ros.Image(height=1, width=2, encoding="rgb8", step=8, data=array("B", rows)), "float32"
    )
    np.testing.assert_allclose(picture, np.array([[[0, 0.6]], [[0.2, 0.8]], [[0.4, 1]]]), rtol=1e-6)
    with pytest.raises(ObservationError, match="found 'bgr8'"):
        node_module.from_picture(ros.Image(encoding="bgr8"), "float32")


def test_messages_that_hold_less_than_they_say_are_refused(node_module: ModuleType) -> None:
    efforts = ros.JointState(name=["wrist", "elbow"], position=array("d"))  # its positions may be left out
    with pytest.raises(ObservationError, match="2 joints and 0 positions"):
        node_module.from_joints(efforts, ["elbow"], "float32")
    for step, size in ((6, 5), (3, 3)):
        half = ros.Image(height=1, width=2, encoding="rgb8", step=step, data=array("B", bytes(size)))
        with pytest.raises(ObservationError, match=f"1 rows of {step} bytes, and 2 pixels in each; found {size} bytes"):
            node_module.from_picture(half, "float32")


def test_the_program_drives_an_artifact_and_says_what_is_wrong(
    once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    artifact = once.folder("toy", lambda directory: written_artifact(toy_program(), directory))
    seen: list[Any] = []

    def spin(node: Any) -> None:
        while not node.made_publishers["~/commands"].published:
            node.deliver(TOPIC, ros.Float64MultiArray(array("d", [0.1, 0.2])))
            node.made_timers[0][1]()
        seen.append(node.made_publishers["~/commands"].published[0].data)

    monkeypatch.setattr(sys, "argv", ["policy_node.py"])
    with ros.installed(spin):
        module = script(FOLDER, "policy_node")
        more = {"plan": "dense", "interpolation": "linear"}
        ros.Node.overrides = {"artifact": str(artifact), "control_hz": 10.0, "policy_hz": 1.0, **more}
        assert module.main() == 0
        ros.Node.overrides = {"artifact": str(tmp_path / "none")}
        assert module.main() == 1
    assert len(seen[0]) == 2
    assert np.isfinite(seen[0]).all()
    assert "error: " in capsys.readouterr().err
    assert workers() == []
