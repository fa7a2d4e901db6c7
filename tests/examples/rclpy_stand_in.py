"""What ``examples/ros2`` uses of rclpy and of ROS 2's messages, without ROS 2: names, arguments, types as documented.

It proves that the node does the right thing with the interface as it is written down here, and nothing about ROS 2:
no discovery, no middleware, no quality of service. Messages are built from keyword arguments and refuse other names, as
generated ones do. Time stands still until a test moves it.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, ClassVar


@dataclass
class Stamp:
    sec: int = 0
    nanosec: int = 0


@dataclass
class Header:
    stamp: Stamp = field(default_factory=Stamp)
    frame_id: str = ""


@dataclass
class Float64MultiArray:
    data: array[float] = field(default_factory=lambda: array("d"))

    def __post_init__(self) -> None:
        assert isinstance(self.data, array)
        assert self.data.typecode == "d"


@dataclass
class JointState:
    header: Header = field(default_factory=Header)
    name: list[str] = field(default_factory=list)
    position: array[float] = field(default_factory=lambda: array("d"))


@dataclass
class Image:
    header: Header = field(default_factory=Header)
    height: int = 0
    width: int = 0
    encoding: str = ""
    step: int = 0
    data: array[int] = field(default_factory=lambda: array("B"))


@dataclass
class KeyValue:
    key: str = ""
    value: str = ""

    def __post_init__(self) -> None:
        assert isinstance(self.value, str)


@dataclass
class DiagnosticStatus:
    level: bytes = b"\x00"
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: list[KeyValue] = field(default_factory=list)


# The constants of a message of ROS are bytes in Python.
DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR = b"\x00", b"\x01", b"\x02"  # type: ignore[attr-defined]


@dataclass
class DiagnosticArray:
    header: Header = field(default_factory=Header)
    status: list[DiagnosticStatus] = field(default_factory=list)


class Trigger:
    @dataclass
    class Request:
        pass

    @dataclass
    class Response:
        success: bool = False
        message: str = ""


@dataclass(frozen=True)
class Duration:
    nanoseconds: int


@dataclass(frozen=True)
class Time:
    nanoseconds: int
    clock_type: str = "ROS_TIME"

    @classmethod
    def from_msg(cls, message: Stamp, clock_type: str = "ROS_TIME") -> Time:
        return cls(message.sec * 10**9 + message.nanosec, clock_type)

    def to_msg(self) -> Stamp:
        return Stamp(*divmod(self.nanoseconds, 10**9))

    def __sub__(self, other: Time) -> Duration:
        assert self.clock_type == other.clock_type, "rclpy refuses to compare times of two clocks"
        return Duration(self.nanoseconds - other.nanoseconds)


class Clock:
    """ROS's clock has nothing to do with the executor's, whose seconds count from another moment."""

    clock_type = "ROS_TIME"

    def __init__(self, seconds: Callable[[], float]) -> None:
        self._seconds = seconds

    def now(self) -> Time:
        return Time(round((self._seconds() + 1.7e9) * 1e9))


@dataclass
class Parameter:
    value: Any


class Logger:
    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warning(self, message: str, throttle_duration_sec: float = 0.0) -> None:
        self.warnings.append(message)


class Publisher:
    def __init__(self, kind: type) -> None:
        self.kind = kind
        self.published: list[Any] = []

    def publish(self, message: Any) -> None:
        assert type(message) is self.kind
        self.published.append(message)


@dataclass(frozen=True)
class QoSProfile:
    depth: int
    durability: str
    reliability: str


class DurabilityPolicy:
    TRANSIENT_LOCAL = "transient local"


class ReliabilityPolicy:
    RELIABLE = "reliable"


SENSOR_DATA = QoSProfile(5, "volatile", "best effort")


class Node:
    """Tests reach what it made by name: ``publishers``, ``subscriptions``, ``services``, ``timers``."""

    overrides: ClassVar[dict[str, Any]] = {}
    seconds: Callable[[], float] = staticmethod(lambda: 0.0)

    def __init__(self, name: str) -> None:
        self._name, self._logger, self._clock = name, Logger(), Clock(type(self).seconds)
        self._parameters: dict[str, Parameter] = {}
        self.made_publishers: dict[str, Publisher] = {}
        self.made_subscriptions: dict[str, tuple[type, Callable[[Any], None]]] = {}
        self.made_qualities: dict[str, QoSProfile] = {}
        self.made_services: dict[str, Callable[[Any, Any], Any]] = {}
        self.made_timers: list[tuple[float, Callable[[], None]]] = []
        self.destroyed = False

    def declare_parameter(self, name: str, value: Any) -> None:
        given = self.overrides.get(name, value)
        assert type(given) is type(value), f"ROS refuses another type for {name}"
        self._parameters[name] = Parameter(given)

    def get_parameter(self, name: str) -> Parameter:
        return self._parameters[name]

    def create_publisher(self, kind: type, topic: str, qos: Any) -> Publisher:
        return self.made_publishers.setdefault(topic, Publisher(kind))

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any) -> None:
        self.made_subscriptions[topic], self.made_qualities[topic] = (kind, callback), qos

    def create_service(self, kind: type, name: str, callback: Callable[[Any, Any], Any]) -> None:
        self.made_services[name] = callback

    def create_timer(self, period: float, callback: Callable[[], None]) -> None:
        self.made_timers.append((period, callback))

    def get_clock(self) -> Clock:
        return self._clock

    def get_logger(self) -> Logger:
        return self._logger

    def get_name(self) -> str:
        return self._name

    def destroy_node(self) -> None:
        self.destroyed = True

    def deliver(self, topic: str, message: Any) -> None:
        """What the middleware does with a message of somebody else."""
        kind, callback = self.made_subscriptions[topic]
        assert type(message) is kind
        callback(message)


def modules(spin: Callable[[Node], None]) -> dict[str, ModuleType]:
    """The packages by name; ``spin`` stands for ``rclpy.spin``."""
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda args: None, "spin": spin, "try_shutdown": lambda: None},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {
            "DurabilityPolicy": DurabilityPolicy,
            "QoSProfile": QoSProfile,
            "ReliabilityPolicy": ReliabilityPolicy,
            "qos_profile_sensor_data": SENSOR_DATA,
        },
        "rclpy.time": {"Time": Time},
        "std_msgs": {},
        "std_msgs.msg": {"Float64MultiArray": Float64MultiArray},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": Image, "JointState": JointState},
        "diagnostic_msgs": {},
        "diagnostic_msgs.msg": {
            "DiagnosticArray": DiagnosticArray,
            "DiagnosticStatus": DiagnosticStatus,
            "KeyValue": KeyValue,
        },
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": Trigger},
    }
    made = {name: ModuleType(name) for name in contents}
    for name, module in made.items():
        vars(module).update(contents[name])
    return made


@contextmanager
def installed(spin: Callable[[Node], None]) -> Iterator[None]:
    """Python finds these in place of ROS 2."""
    made = modules(spin)
    before = {name: sys.modules.get(name) for name in made}
    sys.modules.update(made)
    try:
        yield
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module
