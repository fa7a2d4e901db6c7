"""Messages to the executor's server, and a server without a socket to answer them."""

import asyncio
import base64
import json
import random
from functools import cache
from typing import Any

from tests.hostile.mutate import NUMBERS_NOT_JSON, anything, changed, damaged
from ttscompile import errors

_PACKED = {"dtype": "float64", "shape": [2], "base64": base64.b64encode(bytes(16)).decode()}
_REQUESTS: tuple[dict[str, Any], ...] = (
    {"id": 1, "method": "info"},
    {"id": "a", "method": "observe", "obs": {"obs": [0.5, 1.5]}, "t": 1000.0},
    {"id": 2, "method": "observe", "obs": {"obs": [0.5, 1.5]}},
    {"id": 3, "method": "observe", "obs": {"obs": _PACKED}, "t": 1000.5},
    {"id": 4, "method": "action", "t": 1001.0},
    {"id": 5, "method": "action", "timeout": 0.0},
    {"id": 6, "method": "reset", "seed": 7},
    {"method": "statistics"},
)
_DTYPES = (
    "O",
    "object",
    "V8",
    "f4,f4",
    "(1000000000,)f4",
    "S8",
    "U8",
    "M8[s]",
    "b",
    ">f8",
    "f2",
    "c16",
    "i8",
    "?",
    "g",
)
_SHAPES: tuple[Any, ...] = (
    [2**62],
    [2**31, 2**31],
    [0, 2**63],
    [0],
    [-1],
    ["2"],
    [2.5],
    [1e999],
    "2",
    [[2]],
    {},
    [True],
)


def draw(rng: random.Random) -> str | bytes:
    """One message: a request with something wrong with it, most of the time."""
    request = changed(rng, rng.choice(_REQUESTS))
    kind = rng.random()
    if kind < 0.25 and isinstance(request, dict):
        packed = {
            "dtype": rng.choice(_DTYPES),
            "shape": rng.choice(_SHAPES),
            "base64": rng.choice(("", "AAAA", "!", 7)),
        }
        packed = {**_PACKED, **dict(rng.sample(sorted(packed.items()), rng.randrange(1, 4)))}
        request = {"id": 1, "method": "observe", "obs": {"obs": packed}}
    elif kind < 0.35:
        request = {
            "method": "observe",
            "obs": {"obs": rng.choice(([1e999, 0.0], _deep(rng), _ragged(rng), anything(rng)))},
        }
    text = json.dumps(request)
    if kind > 0.97:
        return text.encode()
    if kind > 0.85:
        return damaged(rng, text.encode()).decode(errors="replace")
    if kind > 0.83:
        return rng.choice(("[" * 200_000, '{"a":' * 100_000, "9" * 500_000, '{"id": ' + "9" * 5000 + "}", "", "\x00"))
    return text


def _deep(rng: random.Random) -> Any:
    value: Any = rng.choice((0.0, "x", None, *NUMBERS_NOT_JSON))
    for _ in range(rng.choice((3, 40, 80))):
        value = [value] * rng.choice((1, 1, 1, 2))
        if len(str(value)) > 10_000:
            break
    return value


def _ragged(rng: random.Random) -> Any:
    return [[0.0] * rng.randrange(3) for _ in range(rng.randrange(4))]


@cache
def _server() -> Any:
    from tests.runtimes.executor.simulation import FakeClock
    from tests.serving.serving import Quick
    from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
    from ttscompile.serving.admission import ServerLimits
    from ttscompile.serving.executor_server import ExecutorServer

    settings = ExecutorSettings(max_hold=1000)
    return ExecutorServer(
        AsyncExecutor(Quick(FakeClock()), 20, settings, latencies={"dense": 0.01}), ServerLimits(action_timeout=0.05)
    )


def start() -> None:
    """Make the server that answers."""
    reply('{"method": "info"}')


def reply(text: str | bytes) -> tuple[str | None, str]:
    """The server's answer: name and message of an error, or None.

    Raises:
        AssertionError: no answer, or an error of the server's own.
    """
    answer = json.loads(asyncio.run(_server()._reply(text)), parse_constant=_never)
    assert set(answer) in ({"id", "result"}, {"id", "error"})
    if "result" in answer:
        return None, ""
    kind = answer["error"]["type"]
    known = getattr(errors, kind, None)
    assert known is not None and issubclass(known, errors.TtscompileError), answer["error"]
    return kind, answer["error"]["message"]


def _never(name: str) -> float:
    raise AssertionError(f"the answer holds {name}")
