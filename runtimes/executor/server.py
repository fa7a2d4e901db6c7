"""The executor behind a local WebSocket, for programs in other processes and languages.

The socket, its framing, its limits and its handshake are the library ``websockets``'; messages are ``protocol``'s. One
event loop serves all clients. What a client does wrong is answered to that client: it is told, or its connection is
closed, and nobody else notices. Only waiting for an action takes a thread, from a pool of a fixed size.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from ttscompile.core.given import integer
from ttscompile.errors import ExecutorError, ProtocolError, RuntimeUnavailableError, TtscompileError

from .executor import AsyncExecutor
from .protocol import Request, answer, failure, read_frame, read_request

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request as Handshake
    from websockets.http11 import Response


WAITS_PER_CLIENT = 4
"""Threads that may wait for an action, a client: one for it, the others for those before it that vanished waiting."""


@dataclass(frozen=True)
class ServerLimits:
    """What clients may do.

    Attributes:
        clients: at a time.
        message_bytes: largest size of a request.
        handshake_timeout: seconds for the opening handshake.
        idle_timeout: seconds between two complete requests.
        send_timeout: seconds that a client may take to read an answer, once its socket's buffers are full.
        action_timeout: seconds that a client may wait for an action.
    """

    clients: int = 8
    message_bytes: int = 1 << 20
    handshake_timeout: float = 5.0
    idle_timeout: float = 60.0
    send_timeout: float = 5.0
    action_timeout: float = 30.0

    def __post_init__(self) -> None:
        for name in ("clients", "message_bytes"):
            object.__setattr__(self, name, integer(getattr(self, name), f"the server's {name}", ExecutorError, 1))
        for name, value in vars(self).items():
            if not value > 0:
                raise ExecutorError(f"the server's {name} must be positive; found {value}.")


class ExecutorServer:
    """Serves one executor; it is the caller's, and is not closed here.

    Args:
        executor: shared by all clients.
        limits: what clients may do; None for the defaults.
    """

    def __init__(self, executor: AsyncExecutor, limits: ServerLimits | None = None) -> None:
        self._executor = executor
        self._limits = limits or ServerLimits()
        self._connected = 0
        waiting = WAITS_PER_CLIENT * self._limits.clients
        self._pool = ThreadPoolExecutor(waiting, thread_name_prefix="ttscompile-serve")
        self._log = logging.getLogger("ttscompile.serve")

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
            ExecutorError: the address cannot be had or is none, or the port is none.
        """
        if not host:  # asyncio would listen on every address of the machine
            raise ExecutorError("cannot listen: host is empty. Give 127.0.0.1, or 0.0.0.0 for every address.")
        port = integer(port, "port", ExecutorError, 0, 65535)
        try:
            from websockets.asyncio.server import serve
        except ModuleNotFoundError as error:
            problem = f"the server needs {error.name}, which is not installed"
            raise RuntimeUnavailableError(f"{problem}. Run: pip install 'ttscompile[serve]'.") from error
        limits = self._limits
        quiet = logging.getLogger("ttscompile.serve.socket")
        quiet.setLevel(logging.CRITICAL)  # what clients do wrong is told to them
        try:
            server = await serve(
                self._client,
                host,
                port,
                origins=[None],  # no web page may drive the robot: a browser sends the origin of its page
                compression=None,
                process_request=self._admit,
                open_timeout=limits.handshake_timeout,
                close_timeout=limits.send_timeout,
                ping_interval=None,  # clients stay simple; the idle timeout finds those that are gone
                max_size=limits.message_bytes,
                max_queue=1,
                logger=quiet,
            )
        except (OSError, OverflowError, UnicodeError) as error:  # also a port above 65535, a name that cannot be one
            remedy = "Choose another port (0 takes any that is free), or an address of this machine."
            why = getattr(error, "strerror", None) or error
            shown = ascii(host[:100])[1:-1]
            raise ExecutorError(f"cannot listen on {shown}:{port}: {why}. {remedy}") from error
        try:
            on_start(*next(iter(server.sockets)).getsockname()[:2])
            await stop.wait()
        finally:
            server.close()
            await server.wait_closed()
            self._pool.shutdown(wait=False, cancel_futures=True)

    def _admit(self, connection: ServerConnection, request: Handshake) -> Response | None:
        if self._connected < self._limits.clients:
            return None
        message = f"{self._limits.clients} clients are connected, and that is how many may be.\n"
        return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, message)

    async def _client(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        self._connected += 1
        try:
            while True:
                try:
                    async with asyncio.timeout(self._limits.idle_timeout):
                        text = await connection.recv()
                except TimeoutError:
                    await connection.close(1008, f"no complete request for {self._limits.idle_timeout:g} s")
                    return
                reply = await self._unless_gone(connection, self._reply(text))
                try:
                    async with asyncio.timeout(self._limits.send_timeout):
                        await connection.send(reply)
                except TimeoutError:
                    connection.transport.abort()
                    return
        except ConnectionClosed:
            return
        finally:
            self._connected -= 1

    async def _unless_gone(self, connection: ServerConnection, reply: Coroutine[Any, Any, str]) -> str:
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

    async def _reply(self, text: str | bytes) -> str:
        request_id = None
        try:
            request = read_request(text)
            request_id = request.id
            return answer(request_id, await self._do(request))
        except ProtocolError as error:
            return failure(getattr(error, "request_id", request_id), error)
        except TtscompileError as error:
            return failure(request_id, error)
        except Exception as error:
            self._log.exception("a request failed for a reason of the server's own")
            return failure(request_id, error)

    async def _do(self, request: Request) -> dict[str, Any]:
        executor, params = self._executor, request.params
        if request.method == "observe":
            executor.observe(read_frame(params["obs"], executor.frames), params.get("t"))
            return {}
        if request.method == "action":
            t, timeout = params.get("t"), params.get("timeout") or 0.0
            if timeout > self._limits.action_timeout:
                raise ProtocolError(f"timeout must be at most {self._limits.action_timeout:g} s; found {timeout:g}.")
            if timeout <= 0:
                return {"action": executor.action(t).tolist()}
            waiting = asyncio.get_running_loop().run_in_executor(self._pool, executor.action, t, timeout)
            return {"action": (await waiting).tolist()}
        if request.method == "reset":
            executor.reset(params.get("seed"))
            return {}
        if request.method == "statistics":
            return executor.statistics().to_json()
        frames, (control_hz, policy_hz) = executor.frames, executor.rates
        return {
            "observation": {
                key: {"shape": list(spec.shape), "dtype": spec.dtype} for key, spec in frames.specs.items()
            },
            "n_obs_steps": frames.steps,
            "control_hz": control_hz,
            "policy_hz": policy_hz,
            "time": executor.now(),
            "max_message_bytes": self._limits.message_bytes,
            "max_timeout": self._limits.action_timeout,
            "idle_timeout": self._limits.idle_timeout,
        }
