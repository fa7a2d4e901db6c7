"""The server that openpi's clients ask: that of a fleet, in openpi's protocol, with one policy of this process."""

import asyncio
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import prod
from typing import Any

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.core.coercion import Array
from ttscompile.core.tokenizer import TASK
from ttscompile.errors import ProtocolError
from ttscompile.runtimes.policy import CompiledPolicy

from .admission import ServerLimits
from .fleet import Answered, FleetServer
from .lock import Lock
from .protocol import DTYPES, Message, Request, read_arrays, read_task

IDLE_TIMEOUT = 3600.0
"""Seconds. These clients say nothing between episodes, and do not come back when they are cut off."""
MOST_KEYS, MOST_VALUES, MOST_PARTS = 64, 4096, 1024
"""Of a map, of a list, and of maps and lists in a message."""
_DTYPES = DTYPES | dict.fromkeys(("bool", "|b1", "b1", "?"), np.dtype(np.bool_))


class OpenPiServer(FleetServer):
    """Serves one policy to openpi's clients. It is the caller's, and computes one request at a time, each an episode.

    Args:
        policy: all requests are computed with the plan that it was loaded with.
        limits: what clients may do; None for the defaults, with an hour between two requests.
        lock: who may come in; None lets every program of this machine in, and nobody else.

    Raises:
        IllegalPlanError: see ``Plans.of``.
    """

    ping_interval = 20.0

    def __init__(
        self, artifact: Artifact, policy: CompiledPolicy, limits: ServerLimits | None = None, lock: Lock | None = None
    ) -> None:
        limits = limits or replace(ServerLimits.of(artifact.manifest.spec.observations, 8), idle_timeout=IDLE_TIMEOUT)
        super().__init__(artifact, self, policy.info.default_plan, limits=limits, lock=lock)
        self._policy = policy
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="ttscompile-serve")

    def greeting(self) -> Message:
        """What the policy is, for ``get_server_metadata`` of the client."""
        return self.encode(None, {**self._facts(), "plan": self._plans.default})

    def read(self, message: Message) -> Request:
        """See ``Listener``."""
        import msgpack

        if isinstance(message, str):
            raise ProtocolError("a request is a binary message with msgpack in it; found a text.")
        parts = iter(range(MOST_PARTS))

        def part(found: Any) -> Any:
            if next(parts, None) is None:
                raise ProtocolError(f"a message has at most {MOST_PARTS} maps and lists.")
            if isinstance(found, dict) and b"__ndarray__" in found:
                return _array(found)
            return found.get(b"data") if isinstance(found, dict) and b"__npgeneric__" in found else found

        limits = {"max_map_len": MOST_KEYS, "max_array_len": MOST_VALUES, "max_ext_len": 0}
        try:
            found = msgpack.unpackb(message, object_hook=part, list_hook=part, strict_map_key=False, **limits)
        except (TypeError, ValueError, RecursionError, msgpack.UnpackException) as error:  # TypeError: a list as a key
            raise ProtocolError(f"the message is no msgpack: {str(error)[:200] or type(error).__name__}.") from error
        if not isinstance(found, dict):
            raise ProtocolError(f"an observation is a map; found {type(found).__name__}.")
        return Request(None, "infer", found)

    def encode(self, request_id: int | str | None, outcome: Mapping[str, Any] | Exception) -> Message:
        """See ``Listener``. The client raises a text."""
        import msgpack

        if isinstance(outcome, Exception):
            return f"{type(outcome).__name__}: {outcome}"
        return bytes(msgpack.packb(outcome))

    async def do(self, request: Request) -> dict[str, Any]:
        """See ``Listener``."""
        start = time.perf_counter()
        actions = await self._ask(self._plans.default, self._observation(request.params))
        array = {b"__ndarray__": True, b"data": actions.tobytes(), b"dtype": actions.dtype.str, b"shape": actions.shape}
        return {"actions": array, "server_timing": {"infer_ms": 1000 * (time.perf_counter() - start)}}

    async def predict(self, plan: str, obs: Mapping[str, Array]) -> Answered:
        """See ``Copies``: it is its own."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, self._call, plan, obs)

    async def trouble(self) -> str:
        """See ``Listener``."""
        return ""

    def end(self) -> None:
        """See ``Listener``."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _call(self, plan: str, obs: Mapping[str, Any]) -> Answered:
        self._policy.reset()
        return Answered(self._policy.predict_action(obs, plan=plan)["action"][0], True)

    def _observation(self, given: Mapping[str, Any]) -> dict[str, Any]:
        obs = dict[str, Any]()
        for key, value in given.items():
            if (spec := self._specs.get(key)) is not None and not isinstance(value, str):
                value = value if isinstance(value, np.ndarray) else read_arrays({key: value}, {key: spec})[key]
                if value.ndim == 0 and prod(spec.shape) == 1:
                    value = value.reshape(spec.shape)
                if spec.frames == 1 and value.ndim == len(spec.shape) - 1:
                    value = value[None]
                obs[key] = value[None]
            elif key not in ("prompt", TASK):
                obs[key] = value
            elif (task := read_task(value)) != self._manifest.spec.source.get("task"):
                obs[TASK] = task
        return obs


def _array(given: Mapping[Any, Any]) -> Array:
    """``{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": [2, 7]}``, the last axis fastest."""
    try:
        dtype = _DTYPES[given[b"dtype"]]  # a look-up: numpy would parse what else it is given as Python
        array = np.frombuffer(given[b"data"], dtype).reshape(given[b"shape"])  # both are views of the message
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        expected = "dtype (bool, little-endian integers or floats), shape, and data of that size"
        raise ProtocolError(f"an array has {expected}; found {error!r:.200}.") from error
    return array.view(np.uint8) > 0 if dtype == np.bool_ else array.astype(dtype.newbyteorder("="))
