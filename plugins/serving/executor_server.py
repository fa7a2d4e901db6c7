"""The executor behind a WebSocket, for programs in other processes and languages.

``listener`` says who may come in, and reads and answers requests. Only waiting for an action takes a thread, from a
pool of a fixed size.
"""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from ttscompile.errors import ProtocolError
from ttscompile.runtimes.executor.executor import AsyncExecutor

from .admission import ServerLimits
from .listener import Listener
from .lock import Lock
from .protocol import METHODS, Metric, Request, of_statistics, read_frame

WAITS_PER_CLIENT = 4
"""Threads that may wait for an action, a client: one for it, the others for those before it that vanished waiting."""


class ExecutorServer(Listener):
    """Serves one executor, which is the caller's and is not closed here. ``Listener`` has limits and lock."""

    methods = METHODS

    def __init__(self, executor: AsyncExecutor, limits: ServerLimits | None = None, lock: Lock | None = None) -> None:
        super().__init__(limits, lock)
        self._executor = executor
        waiting = WAITS_PER_CLIENT * self._limits.clients
        self._pool = ThreadPoolExecutor(waiting, thread_name_prefix="ttscompile-serve")

    def end(self) -> None:
        """See ``Listener``."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    async def trouble(self) -> str:
        """See ``Listener``."""
        return self._executor.trouble

    def metrics(self) -> list[Metric]:
        """See ``Listener``."""
        return of_statistics(self._executor.statistics())

    async def do(self, request: Request) -> dict[str, Any]:
        """See ``Listener``."""
        executor, params = self._executor, request.params
        if request.method == "observe":
            frame = await self.apart(request.large, read_frame, params["obs"], executor.frames.specs)
            executor.observe(frame, params.get("t"))
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
