"""What clients of a server may do; and who is at it, who may come in, and who came.

They are counted by address from the moment that a socket is accepted. The library ``websockets`` sees a connection when
its handshake begins, which under TLS is late: who never finishes it is not seen at all. So the listening socket itself
asks (``AdmittingSocket``), and the socket of a connection says when it ends (``AdmittedSocket``).
"""

from __future__ import annotations

import json
import logging
import os
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from datetime import datetime, timezone
from http import HTTPStatus
from ipaddress import ip_address, ip_network
from math import prod
from typing import Any

from ttscompile.core.coercion import integer
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import ExecutorError

NUMBER_BYTES = 8
"""Of a message for each number of an observation: a float32 in base64 takes 5.4 bytes, a pixel in digits takes four."""
PIXELS = 1280 * 720
"""Of a picture that the policy resizes: a message has room for one of so many, whatever the policy makes of it."""
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
        resized = [one.shape for one in observations.values() if one.fit is not None]
        more = sum(prod(shape[:-2]) * max(PIXELS - prod(shape[-2:]), 0) for shape in resized)
        size, values = NUMBER_BYTES * (numbers + more) + (1 << 16), VALUES * numbers + 1000
        return cls(clients, max(cls.message_bytes, size), max(cls.message_values, values))

    def __post_init__(self) -> None:
        for one in fields(self):
            name, value = one.name, getattr(self, one.name)
            if value is not None and one.type in ("int", "int | None"):
                object.__setattr__(self, name, integer(value, f"the server's {name}", ExecutorError, 1))
            elif value is not None and not value > 0:
                raise ExecutorError(f"the server's {name} must be positive; found {value}.")


AUDIT = logging.getLogger("ttscompile.serve.audit")
"""Gets one line of JSON for each connection that is let in or refused, and one when it ends."""
MINUTE = 60.0
MOST_ADDRESSES = 4096
"""Whose refusals are remembered; beyond, those of the address that came first are forgotten."""


@dataclass
class Connection:
    """A connection, from its socket's acceptance to its end.

    Attributes:
        network: of the address, which limits are counted by.
        answered: whether its handshake was answered, and so told in the audit.
    """

    number: int
    peer: str
    network: str
    since: float
    client: bool = False
    answered: bool = False
    requests: int = 0


class Admission:
    """Counts and limits; used by the server's event loop alone."""

    def __init__(self, limits: ServerLimits, clock: Callable[[], float] = time.monotonic) -> None:
        self.limits = limits
        self._clock = clock
        self._connections: dict[tuple[Any, Any], Connection] = {}  # two addresses of the server may have one peer
        self._refusals: dict[str, deque[float]] = {}
        self._told: dict[str, float] = {}
        self._count = 0

    @property
    def clients(self) -> int:
        """How many are connected."""
        return sum(each.client for each in self._connections.values())

    def comes(self, peer: tuple[Any, ...], own: Any = None) -> bool:
        """Whether the handshake of a connection may begin; both addresses together name it, from here on."""
        network, now = network_of(peer[0]), self._clock()
        waiting = [each.network for each in self._connections.values() if not each.client]
        if self._refused_lately(network, now) >= self.limits.refusals_per_minute:
            why = f"{self.limits.refusals_per_minute} of its handshakes failed within a minute"
        elif len(waiting) >= self.limits.handshakes or waiting.count(network) >= self.limits.handshakes_per_address:
            why = "too many handshakes are under way"
        else:
            self._count += 1
            self._connections[peer, own] = Connection(self._count, _shown(peer), network, now)
            return True
        if now - self._told.get(network, -MINUTE) >= MINUTE:  # one line: whoever is cut off must not fill the disk
            self._remember(self._told, network, now)
            _write("cut off", _shown(peer), why=f"{why}; others of this minute are not written")
        return False

    def refusal(self, peer: tuple[Any, ...], own: Any = None) -> str:
        """Why one more client of this address cannot be had now; empty if it can."""
        clients = Counter(each.network for each in self._connections.values() if each.client)
        if clients.total() >= self.limits.clients:
            return f"{self.limits.clients} clients are connected, and that is how many may be."
        most = self.limits.clients_per_address
        if most is not None and clients[self._connections[peer, own].network] >= most:
            return f"{most} clients of this address are connected, and that is how many may be."
        return ""

    def answers(self, peer: tuple[Any, ...], status: int, tls: str | None, own: Any = None) -> None:
        """Note how a handshake was answered: 101 makes it a client, and 200 is for somebody who watches."""
        connection = self._connections[peer, own]
        connection.answered, connection.client = True, status == HTTPStatus.SWITCHING_PROTOCOLS
        no_fault_of_theirs = status in (HTTPStatus.OK, HTTPStatus.SERVICE_UNAVAILABLE)
        if not connection.client and not no_fault_of_theirs:
            self._refuse(connection.network)
        event = "let in" if connection.client else "told" if status == HTTPStatus.OK else "refused"
        _write(event, connection.peer, connection=connection.number, status=int(status), tls=tls)

    def requested(self, peer: tuple[Any, ...], own: Any = None) -> None:
        """Count a request; of a connection that was cut off meanwhile one may still be read."""
        if (connection := self._connections.get((peer, own))) is not None:
            connection.requests += 1

    def offends(self, peer: tuple[Any, ...], own: Any = None) -> None:
        """Count a client that is cut off as a handshake that failed."""
        if (connection := self._connections.get((peer, own))) is not None:
            self._refuse(connection.network)

    def leaves(self, peer: tuple[Any, ...], own: Any = None) -> None:
        """Forget a connection whose socket is closed."""
        connection = self._connections.pop((peer, own), None)
        if connection is None:
            return
        seconds = round(self._clock() - connection.since, 3)
        if connection.client:
            _write("left", connection.peer, connection=connection.number, requests=connection.requests, seconds=seconds)
        elif not connection.answered:
            self._refuse(connection.network)
            why = "it did not finish its handshake"
            _write("refused", connection.peer, connection=connection.number, why=why, seconds=seconds)

    def _refuse(self, network: str) -> None:
        if network not in self._refusals:
            self._remember(self._refusals, network, deque(maxlen=self.limits.refusals_per_minute))
        self._refusals[network].append(self._clock())

    def _refused_lately(self, network: str, now: float) -> int:
        times = self._refusals.get(network, deque())
        while times and now - times[0] >= MINUTE:
            times.popleft()
        return len(times)

    @staticmethod
    def _remember(table: dict[str, Any], network: str, value: Any) -> None:
        table.pop(network, None)
        table[network] = value
        if len(table) > MOST_ADDRESSES:
            del table[next(iter(table))]


class AdmittingSocket(socket.socket):
    """A listening socket that asks about every connection, before a byte of it is read."""

    def __init__(self, admission: Admission, family: int) -> None:
        super().__init__(family, socket.SOCK_STREAM)
        self._admission = admission
        self.setblocking(False)
        if os.name == "posix":  # elsewhere it would let two servers share a port
            self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:  # IPv4 has a socket of its own
            self.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)

    def accept(self) -> tuple[socket.socket, Any]:
        """As of any socket; a connection that may not begin is closed, as if nobody had come."""
        accepted, peer = super().accept()
        try:
            own = accepted.getsockname()
            if self._admission.comes(peer, own):
                return AdmittedSocket(self._admission, peer, own, accepted), peer
        except OSError:  # of some systems, where the connection has ended already
            pass
        accepted.close()
        raise BlockingIOError  # what an event loop expects; it looks after the others before it comes again


class AdmittedSocket(socket.socket):
    """The socket of a connection, which tells when it is closed."""

    def __init__(self, admission: Admission, peer: Any, own: Any, accepted: socket.socket) -> None:
        super().__init__(accepted.family, accepted.type, accepted.proto, fileno=accepted.detach())
        self._admission, self._peer, self._own = admission, peer, own

    def close(self) -> None:
        """As of any socket."""
        super().close()
        self._admission.leaves(self._peer, self._own)


class Pace:
    """How long a client's next request has to wait, so that it has no more than its share of a second.

    Args:
        per_second: requests; as many may come at once after a quiet second.
        now: seconds of any clock.
    """

    def __init__(self, per_second: float, now: float) -> None:
        self._each = 1 / per_second
        self._paid = now - 1

    def wait(self, now: float) -> float:
        """Seconds."""
        self._paid = max(self._paid, now - 1) + self._each
        return max(self._paid - now, 0.0)


def network_of(address: str) -> str:
    """What limits are counted by: an IPv4 address, or the network of 64 bits that one household has of IPv6."""
    ip = ip_address(address.partition("%")[0])
    return str(ip) if ip.version == 4 else str(ip_network((ip, 64), strict=False))


def _shown(peer: tuple[Any, ...]) -> str:
    return f"[{peer[0]}]:{peer[1]}" if ":" in peer[0] else f"{peer[0]}:{peer[1]}"


def _write(event: str, peer: str, **more: Any) -> None:
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    AUDIT.info(json.dumps({"time": now, "event": event, "from": peer, **more}))
