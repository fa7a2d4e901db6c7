"""A ROS 2 node around a compiled policy: observations in, joint commands out, deadlines as diagnostics.

    python examples/ros2/policy_node.py --ros-args -p artifact:=compiled/ -p control_hz:=50.0 -p policy_hz:=10.0

Needs rclpy and the messages of a ROS 2 installation, beside ttscompile with numpy and onnxruntime. **It was never run
with ROS 2.** Its tests use a stand-in for the part of rclpy that is named here (``tests/examples/rclpy_stand_in.py``).

===========================  ==========================================  ==============================================
topic or service             type                                        what
===========================  ==========================================  ==============================================
``~/observation/KEY``        ``std_msgs/Float64MultiArray``              one frame of an observation, flat
the same, for pictures       ``sensor_msgs/Image``, ``rgb8``             one frame ``[3, H, W]``, scaled to 0..1
the same, for ``joint_key``  ``sensor_msgs/JointState``                  positions, in the order of ``joints``
the same, for a goal         ``std_msgs/Float64MultiArray``              published once, with durability TRANSIENT_LOCAL
``~/commands``               ``std_msgs/Float64MultiArray``              the action for now; none where there is none
``/diagnostics``             ``diagnostic_msgs/DiagnosticArray``         once a second, what the executor counts
``~/reset``                  ``std_srvs/Trigger``                        a new episode
===========================  ==========================================  ==============================================

A group controller of ``ros2_control`` takes ``~/commands`` as they are. When no action comes, it has to stop the robot
by a timeout of its own: nothing is repeated here beyond ``ExecutorSettings.max_hold``.
"""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

import ttscompile
from ttscompile.errors import DeadlineMissedError, ExecutorError, ObservationError, TtscompileError
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.executor.window import FrameSpec

Array = npt.NDArray[Any]
PARAMETERS = {
    "artifact": "",
    "control_hz": 50.0,
    "policy_hz": 0.0,
    "threads": 1,
    "plan": "",
    "interpolation": "hold",
    "frame_key": "",
    "joint_key": "",
    "joints": [""],
    "goal_keys": [""],
}
"""Name -> default.

``policy_hz``: 0 for what the artifact says. ``plan``: empty for the default plan. ``frame_key``: the observation that
completes a frame; empty for the first that is no goal. ``goal_keys``: observations that stay as they are until they are
published again, over a reset, too; empty for the numbers that have no window, where other observations have one.
"""

PUBLISHED_ONCE = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
)
"""Of goals: a node that starts later is given the last one, too. A publisher without this durability is not heard."""

LATE = ("deadlines_missed", "reserve", "holds", "starved", "chunks_refused", "chunks_overdue")
"""What the executor counts when something came too late, or was refused; ``starved``: there was no action."""


class PolicyNode(Node):
    """One policy, one robot.

    All callbacks run on the thread that spins the node, and none of them waits: the policy has a thread of its own.

    Args:
        open_executor: makes the executor from the node's parameters; it is closed by ``destroy_node``.
    """

    def __init__(self, open_executor: Callable[[Mapping[str, Any]], AsyncExecutor]) -> None:
        super().__init__("ttscompile_policy")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        given = {name: self.get_parameter(name).value for name in PARAMETERS}
        self._executor = open_executor(given)
        specs, self._goals = self._executor.frames.specs, goals(given, self._executor.frames)
        self._joints = [name for name in given["joints"] if name]
        self._frame_key = given["frame_key"] or next((key for key in specs if key not in self._goals), "")
        for option, names in (
            ("frame_key", [self._frame_key]),
            ("joint_key", [given["joint_key"]]),
            ("goal_keys", self._goals),
        ):
            if unknown := sorted(set(filter(None, names)) - specs.keys()):
                raise ObservationError(f"{option} is {unknown[0]!r}; the policy observes {sorted(specs)}.")
        if self._frame_key in {"", *self._goals}:
            raise ObservationError(f"frame_key must come with every frame, and goal_keys are {sorted(self._goals)}.")
        self._latest: dict[str, tuple[Array, float]] = {}
        self._told = self._executor.statistics()
        self._refused, self._why = 0, ""
        for key, spec in specs.items():
            kind, read = Float64MultiArray, partial(from_numbers, shape=spec.shape, dtype=spec.dtype)
            if key == given["joint_key"]:
                kind, read = JointState, partial(from_joints, joints=self._joints, dtype=spec.dtype)
            elif len(spec.shape) == 3:
                kind, read = Image, partial(from_picture, dtype=spec.dtype)
            topic = f"~/observation/{key.replace('.', '/')}"
            quality = PUBLISHED_ONCE if key in self._goals else qos_profile_sensor_data
            self.create_subscription(kind, topic, partial(self.on_message, key, read), quality)
        self._commands = self.create_publisher(Float64MultiArray, "~/commands", 1)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(Trigger, "~/reset", self.on_reset)
        self.create_timer(1 / given["control_hz"], self.on_tick)
        self.create_timer(1.0, self.on_diagnostics)

    def on_message(self, key: str, read: Callable[[Any], Array], message: Any) -> None:
        """Keep what was observed last; with ``frame_key`` give the executor a frame, as old as its oldest part.

        A goal has no age.
        """
        try:
            self._latest[key] = read(message), math.inf if key in self._goals else self._taken(message)
            if key == self._frame_key and not self._missing:
                frame = {name: value for name, (value, _) in self._latest.items()}
                self._executor.observe(frame, min(taken for _, taken in self._latest.values()))
        except ObservationError as error:
            self._refused += 1
            self._why = f"observation {key!r}: {error}"
            self.get_logger().warning(self._why, throttle_duration_sec=1.0)

    def on_tick(self) -> None:
        """Publish the action for now, if there is one."""
        if not self._executor.ready:
            return
        try:
            action = self._executor.action()
        except DeadlineMissedError as error:  # counted, and told by the diagnostics
            self._why = str(error)
            return
        self._commands.publish(Float64MultiArray(data=array("d", action.tolist())))

    def on_diagnostics(self) -> None:
        """Tell what happened since the last time: ERROR if an action was missing, WARN if anything was late."""
        now, before = self._executor.statistics(), self._told
        late = {name: getattr(now, name) - getattr(before, name) for name in LATE} | {"refused": self._refused}
        waiting = f"waiting for {', '.join(self._missing) or 'observations'}"
        level, message = DiagnosticStatus.OK, "on time" if self._executor.ready else waiting
        if trouble := self._executor.trouble:
            level, message = DiagnosticStatus.WARN, f"{trouble}; {waiting}" if self._missing else trouble
        if any(late.values()):
            level, message = DiagnosticStatus.WARN, self._why or now.last_refusal or "chunks come late"
        if late["starved"]:
            level = DiagnosticStatus.ERROR
        values = {"plan": now.plan, "artifact": now.identity, "ticks": now.ticks, "calls": now.calls, **late}
        for name in ("latency_ms", "action_age_ms"):
            found = getattr(now, name)
            values |= {} if found is None else {f"{name} p50": f"{found.p50:.1f}", f"{name} p99": f"{found.p99:.1f}"}
        status = DiagnosticStatus(level=level, name=self.get_name(), message=message, hardware_id="")
        status.values = [KeyValue(key=name, value=str(value)) for name, value in values.items()]
        told = DiagnosticArray(status=[status])
        told.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(told)
        self._told, self._refused, self._why = now, 0, ""

    def on_reset(self, request: Any, response: Any) -> Any:
        """A new episode: nothing that was observed or computed before is played after it, but goals stay."""
        self._executor.reset()
        self._latest = {key: seen for key, seen in self._latest.items() if key in self._goals}
        response.success, response.message = True, "a new episode"
        return response

    @property
    def _missing(self) -> list[str]:
        """Observations that have not come in this episode."""
        return [key for key in self._executor.frames.specs if key not in self._latest]

    def destroy_node(self) -> None:
        """End the policy's thread too."""
        try:
            self._executor.close()
        finally:
            super().destroy_node()

    def _taken(self, message: Any) -> float:
        """When a message was observed, on the executor's clock; now, where it has no stamp."""
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        if stamp is None or (stamp.sec, stamp.nanosec) == (0, 0):
            return self._executor.now()
        clock = self.get_clock()
        age = (clock.now() - Time.from_msg(stamp, clock_type=clock.clock_type)).nanoseconds
        return self._executor.now() - max(age, 0) / 1e9


def goals(given: Mapping[str, Any], frames: FrameSpec) -> frozenset[str]:
    """Observations that stay as they are until they are published again: see ``PARAMETERS``."""
    if told := frozenset(filter(None, given["goal_keys"])):
        return told
    sensors = {*frames.history, given["frame_key"], given["joint_key"]}
    numbers = {key for key, spec in frames.specs.items() if len(spec.shape) < 3}
    return frozenset(numbers - sensors if frames.history else ())


def from_numbers(message: Any, shape: Sequence[int], dtype: str) -> Array:
    """One frame of numbers, in the order of C."""
    numbers = np.asarray(message.data, dtype)
    if numbers.size != np.prod(shape, dtype=int):
        raise ObservationError(f"expected {list(shape)} numbers; found {numbers.size}.")
    return numbers.reshape(shape)


def from_joints(message: Any, joints: Sequence[str], dtype: str) -> Array:
    """Positions in the policy's order; drivers give them in any."""
    places = {name: place for place, name in enumerate(message.name)}
    if lacking := [name for name in joints if name not in places]:
        raise ObservationError(f"joints {lacking} are not in the message, which has {sorted(places)}.")
    if len(message.position) < len(places):  # a driver may send velocities or efforts alone
        raise ObservationError(f"the message has {len(places)} joints and {len(message.position)} positions.")
    return np.asarray([message.position[places[name]] for name in joints], dtype)


def from_picture(message: Any, dtype: str) -> Array:
    """``[3, H, W]`` in 0..1 from ``rgb8``; rows may be longer than what they show."""
    if message.encoding != "rgb8":
        raise ObservationError(f"expected a picture of encoding 'rgb8'; found {message.encoding!r}.")
    if len(message.data) != message.height * message.step or message.step < 3 * message.width:
        size = f"{message.height} rows of {message.step} bytes, and {message.width} pixels in each"
        raise ObservationError(f"expected a picture of {size}; found {len(message.data)} bytes.")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : 3 * message.width].reshape(message.height, message.width, 3)
    picture = np.ascontiguousarray(pixels.transpose(2, 0, 1)).astype(dtype)
    return picture if np.issubdtype(dtype, np.integer) else picture / np.asarray(255, dtype)


def open_executor(given: Mapping[str, Any]) -> AsyncExecutor:
    """The executor that the parameters ask for."""
    policy = ttscompile.load(given["artifact"], plan=given["plan"] or None, threads=given["threads"])
    if not (rate := given["policy_hz"] or policy.info.policy_hz):
        raise ExecutorError(f"{given['artifact']} does not say the rate of its training. Give the parameter policy_hz.")
    settings = ExecutorSettings(policy_hz=rate, interpolation=given["interpolation"])
    return AsyncExecutor(policy, given["control_hz"], settings)


def main() -> int:
    """Spin until ROS shuts down; 1 if the policy cannot run or has ended by an error."""
    rclpy.init(args=sys.argv)
    node = None
    try:
        node = PolicyNode(open_executor)
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    except (TtscompileError, ExecutorError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
