"""What every server here does alike: who may come in, at which pace, and how requests are read and answered.

The socket, its framing, its limits and its handshake are the library ``websockets``'; messages are ``protocol``'s. Who
may come in is the matter of ``lock`` and ``admission``. One event loop serves all clients. What a client does wrong is
answered to that client: it is told, or its connection is closed, and nobody else notices. A plain GET of ``/health`` or
``/metrics`` is answered on the same port, behind the same lock.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping
from contextlib import ExitStack
from functools import partial
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, cast

from ttscompile.core.coercion import integer
from ttscompile.errors import ExecutorError, TtscompileError, needing

from .admission import Admission, AdmittingSocket, Pace, ServerLimits
from .lock import Lock
from .protocol import CONTENT_TYPE, LARGE, Message, Methods, Metric, Request, answer, exposition, read_request

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request as Handshake, Response


HEALTH, METRICS = "/health", "/metrics"
"""Paths of a plain GET."""

_NOT_HERE = (errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL)
"""Errors of an address that a name has and this machine has not: ``::1`` of ``localhost`` where there is no IPv6."""
_BACKLOG = 100
"""Connections that wait to be accepted, as asyncio has it."""


class Listener(ABC):
    """A server for clients that ask over a WebSocket.

    Args:
        limits: what clients may do; None for the defaults.
        lock: who may come in; None lets every program of this machine in, and nobody else.
    """

    methods: Methods
    ping_interval: float | None = None  # without pings the idle timeout finds those that are gone: clients stay simple

    def __init__(self, limits: ServerLimits | None = None, lock: Lock | None = None) -> None:
        self._limits = limits or ServerLimits()
        self._lock = lock or Lock()
        self._admission = Admission(self._limits)
        self._answers: Counter[tuple[str, str]] = Counter()  # by method and outcome
        self._log = logging.getLogger("ttscompile.serve")

    @abstractmethod
    async def do(self, request: Request) -> dict[str, Any]:
        """The result of a request. Raises TtscompileError: told to the client that asked."""

    def greeting(self) -> Message | None:
        """What a client is sent first, before it asks anything; None for nothing."""
        return None

    def read(self, message: Message) -> Request:
        """The request that a message is. Raises ProtocolError: it is none."""
        return read_request(message, self.methods, self._limits.message_values)

    def encode(self, request_id: int | str | None, outcome: Mapping[str, Any] | Exception) -> Message:
        """The message that tells a client the result of its request, or what went wrong."""
        return answer(request_id, outcome)

    @abstractmethod
    async def trouble(self) -> str:
        """Why nothing can be answered at present; empty where it can."""

    @abstractmethod
    def metrics(self) -> list[Metric]:
        """What ``/metrics`` shows beside what every server counts."""

    async def apart(self, large: bool, call: Callable[..., Any], *arguments: Any) -> Any:
        """What a function gives; where it has much to do in a thread, so that other clients are served meanwhile."""
        return await asyncio.to_thread(call, *arguments) if large else call(*arguments)

    def end(self) -> None:  # noqa: B027  # some servers hold nothing
        """Called once, when the server has ended."""

    async def run(
        self,
        host: str,
        port: int,
        stop: asyncio.Event,
        on_start: Callable[[str, int], None] = lambda address, port: None,
    ) -> None:
        """Serve until ``stop`` is set.

        Args:
            host: address to listen on; ``127.0.0.1`` cannot be reached from another machine.
            port: 0 for any that is free.
            stop: set it, in this event loop, to end.
            on_start: told address and port, as the socket has them.

        Raises:
            RuntimeUnavailableError: ``websockets`` is not installed.
            ExecutorError: the address cannot be had or is none, or the port is none; or others than programs of this
                machine may reach it, and the lock does not allow that.
        """
        if not host:  # asyncio would listen on every address of the machine
            raise ExecutorError("cannot listen: host is empty. Give 127.0.0.1, or 0.0.0.0 for every address.")
        port = integer(port, "port", ExecutorError, 0, 65535)
        with needing("the server", "serve"):
            self.greeting()  # may need a package, too
            from websockets.asyncio.server import serve

            from .connection import CountedConnection
        quiet = logging.getLogger("ttscompile.serve.socket")
        quiet.setLevel(logging.CRITICAL)  # what clients do wrong is told to them
        entrances = await self._listen(host, port)
        limits, tls = self._limits, self._lock.tls
        timeouts: dict[str, Any] = {}
        if tls is not None:
            timeouts = {"ssl_handshake_timeout": limits.handshake_timeout, "ssl_shutdown_timeout": limits.send_timeout}
        servers = [
            await serve(
                self._client,
                sock=entrance,
                origins=[None],  # no web page may drive the robot: a browser sends the origin of its page
                compression=None,
                process_request=self._admit,
                process_response=self._answered,
                open_timeout=limits.handshake_timeout,
                close_timeout=limits.send_timeout,
                ping_interval=self.ping_interval,
                max_size=limits.message_bytes,
                max_queue=1,
                create_connection=cast(Any, partial(CountedConnection, self._admission, limits)),
                logger=quiet,
                ssl=tls,
                **timeouts,
            )
            for entrance in entrances
        ]
        try:
            on_start(*entrances[0].getsockname()[:2])
            await stop.wait()
        finally:
            for server in servers:
                server.close()
            for server in servers:
                await server.wait_closed()
            self.end()

    async def _listen(self, host: str, port: int) -> list[AdmittingSocket]:
        """A socket for each address that the host has, all of one port; two for ``localhost``, where there is IPv6.

        An address that this machine has not is left out, with a line in the log, where there is another.
        """
        loop, made, absent = asyncio.get_running_loop(), list[AdmittingSocket](), list[tuple[str, OSError]]()
        with ExitStack() as opened:
            try:
                found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
                for family, (name, own, *more) in dict.fromkeys((family, address) for family, *_, address in found):
                    if own == 0 and made:
                        own = made[0].getsockname()[1]
                    try:
                        entrance = opened.enter_context(AdmittingSocket(self._admission, family))
                        entrance.bind((name, own, *more))
                    except OSError as error:
                        if error.errno not in _NOT_HERE:
                            raise
                        absent.append((str(name), error))
                        continue
                    self._lock.require(entrance.getsockname()[0])
                    made.append(entrance)
                if absent and not made:
                    raise absent[0][1]
                for entrance in made:
                    entrance.listen(_BACKLOG)
                for name, why_not in absent:
                    self._log.warning("not listening on %s: %s", name, why_not.strerror)
            except (OSError, OverflowError, UnicodeError) as error:  # also a name that cannot be one
                remedy = "Choose another port (0 takes any that is free), or an address of this machine."
                why = getattr(error, "strerror", None) or error
                shown = ascii(host[:100])[1:-1]
                raise ExecutorError(f"cannot listen on {shown}:{port}: {why}. {remedy}") from error
            opened.pop_all()
        return made

    async def _admit(self, connection: ServerConnection, request: Handshake) -> Response | None:
        """Refuse a handshake without the token, then one more client than there may be: strangers learn no more."""
        given = request.headers.get_all("Authorization")
        if not self._lock.opens(given[0] if len(given) == 1 else None):
            response = connection.respond(HTTPStatus.UNAUTHORIZED, "The token is missing or wrong.\n")
            response.headers["WWW-Authenticate"] = "Bearer"
            return response
        if "Upgrade" not in request.headers and request.path in (HEALTH, METRICS):
            return await self._told(connection, request.path)
        if full := self._admission.refusal(connection.remote_address, connection.local_address):
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{full}\n")
        return None

    async def _told(self, connection: ServerConnection, path: str) -> Response:
        if path == HEALTH:
            trouble = await self.trouble()
            status = HTTPStatus.SERVICE_UNAVAILABLE if trouble else HTTPStatus.OK
            return connection.respond(status, f"{trouble or 'ok'}\n")
        answers = [({"method": method, "outcome": how}, count) for (method, how), count in self._answers.items()]
        own = [
            Metric("clients", "gauge", "Clients that are connected.", [({}, self._admission.clients)]),
            Metric("requests_total", "counter", "Requests answered, by method and outcome.", answers),
        ]
        response = connection.respond(HTTPStatus.OK, exposition([*own, *self.metrics()]))
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = CONTENT_TYPE
        return response

    def _answered(self, connection: ServerConnection, _: Handshake, response: Response) -> None:
        tls = connection.transport.get_extra_info("ssl_object")
        version, own = tls.version() if tls else None, connection.local_address
        self._admission.answers(connection.remote_address, response.status_code, version, own)

    async def _client(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        loop, peer, own = asyncio.get_running_loop(), connection.remote_address, connection.local_address
        pace = Pace(self._limits.requests_per_second, loop.time())
        try:
            reply = self.greeting()
            while True:
                if reply is not None:
                    try:
                        await asyncio.wait_for(connection.send(reply), self._limits.send_timeout)
                    except asyncio.TimeoutError:
                        connection.transport.abort()
                        return
                try:
                    message = await asyncio.wait_for(connection.recv(), self._limits.idle_timeout)
                except asyncio.TimeoutError:
                    await connection.close(1008, f"no complete request for {self._limits.idle_timeout:g} s")
                    return
                self._admission.requested(peer, own)
                if wait := pace.wait(loop.time()):
                    await asyncio.sleep(wait)
                reply = await self._unless_gone(connection, self._reply(message))
        except ConnectionClosed:
            return

    async def _unless_gone(self, connection: ServerConnection, reply: Coroutine[Any, Any, Message]) -> Message:
        """The reply; raises ``ConnectionClosed`` as soon as nobody waits for it any more."""
        replying = asyncio.ensure_future(reply)
        gone = asyncio.ensure_future(connection.wait_closed())
        try:
            await asyncio.wait({replying, gone}, return_when=asyncio.FIRST_COMPLETED)
            if replying.done():
                return replying.result()
            replying.cancel()
            raise connection.protocol.close_exc
        finally:
            gone.cancel()

    async def _reply(self, message: Message) -> Message:
        request_id, method, outcome = None, "unknown", "ok"
        try:
            request = await self.apart(len(message) > LARGE, self.read, message)
            request_id, method = request.id, request.method
            return self.encode(request_id, await self.do(request))
        except TtscompileError as error:
            outcome = type(error).__name__
            return self.encode(getattr(error, "request_id", request_id), error)
        except Exception as error:
            outcome = "defect"
            self._log.exception("a request failed for a reason of the server's own")
            return self.encode(request_id, error)
        finally:
            self._answers[method, outcome] += 1
