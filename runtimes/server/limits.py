"""What clients of the server may do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import prod

from ttscompile.core.coercion import integer
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import ExecutorError

NUMBER_BYTES = 8
"""Of a message for each number of an observation: a float32 in base64 takes 5.4 bytes, a pixel in digits takes four."""
VALUES = 3
"""Of a message for each number of an observation: lists of one number have a bracket and a comma beside it."""


@dataclass(frozen=True)
class ServerLimits:
    """What clients may do.

    Attributes:
        clients: at a time.
        message_bytes: largest size of a request.
        message_values: most values of its JSON, numbers of lists among them.
        handshake_timeout: seconds for the opening handshake, and before that as many for TLS.
        idle_timeout: seconds between two complete requests.
        send_timeout: seconds that a client may take to read an answer, once its socket's buffers are full.
        action_timeout: seconds that a client may wait for an action.
        clients_per_address: of the clients, those of one address (of IPv6, one network of 64 bits); None for all.
        control_per_second: pings and fragments without content of one client, with a second's worth at once; one that
            sends more is cut off.
        requests_per_second: of one client, with a second's worth at once; the rest waits its turn.
        handshakes: connections that are not clients yet, at a time.
        handshakes_per_address: of these, those of one address.
        refusals_per_minute: handshakes of one address that may fail. After that it is cut off, before TLS begins, until
            a minute has gone by: each handshake takes time from the robot's processor.
    """

    clients: int = 8
    message_bytes: int = 1 << 20
    message_values: int = 20_000
    handshake_timeout: float = 5.0
    idle_timeout: float = 60.0
    send_timeout: float = 5.0
    action_timeout: float = 30.0
    clients_per_address: int | None = None
    control_per_second: float = 100.0
    requests_per_second: float = 2000.0
    handshakes: int = 64
    handshakes_per_address: int = 16
    refusals_per_minute: int = 20

    @classmethod
    def of(cls, observations: Mapping[str, ObservationSpec], clients: int) -> ServerLimits:
        """Limits of a server that is sent such observations; a message may have 1 MiB and 20,000 values at least."""
        numbers = sum(prod(one.shape) for one in observations.values())
        size, values = NUMBER_BYTES * numbers + (1 << 16), VALUES * numbers + 1000
        return cls(clients, max(cls.message_bytes, size), max(cls.message_values, values))

    def __post_init__(self) -> None:
        for one in fields(self):
            name, value = one.name, getattr(self, one.name)
            if value is not None and one.type in ("int", "int | None"):
                object.__setattr__(self, name, integer(value, f"the server's {name}", ExecutorError, 1))
            elif value is not None and not value > 0:
                raise ExecutorError(f"the server's {name} must be positive; found {value}.")
