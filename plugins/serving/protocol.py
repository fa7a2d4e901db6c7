"""What goes over a server's socket: messages of the executor's server, and figures of any.

Messages are JSON texts, one answer a request; ``docs/serve.md`` has the protocol. Figures are in the text format that
Prometheus reads (version 0.0.4).
"""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ttscompile.core.coercion import Array
from ttscompile.core.spec import ObservationSpec
from ttscompile.core.tokenizer import TASK
from ttscompile.core.untrusted_json import MAX_VALUES, most_values
from ttscompile.errors import ProtocolError
from ttscompile.runtimes.executor.statistics import COUNTS, ExecutorStatistics, Summary

Message = str | bytes
Methods = Mapping[str, frozenset[str]]
"""Method -> the parameters that it may have."""

METHODS: Methods = {
    "info": frozenset(),
    "observe": frozenset({"obs", "t"}),
    "action": frozenset({"t", "timeout"}),
    "reset": frozenset({"seed"}),
    "statistics": frozenset(),
}
"""Of the executor's server."""

DTYPES = {
    name: dtype
    for dtype in map(np.dtype, ("<i1", "<i2", "<i4", "<i8", "<u1", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"))
    for name in (dtype.name, dtype.str, dtype.str[1:])
}
"""What a packed array may be of, by each of its names: ``uint8``, ``|u1``, ``u1``."""
KINDS = {"b": "biu", "i": "iu", "u": "iu", "f": "iuf"}
"""By the kind of an expected dtype: the kinds that the numbers of lists may have."""
LARGE = 1 << 15
"""Characters of a message that is read beside the event loop, which then serves others meanwhile."""
LONGEST_TASK = 4096
"""Characters: a client's text is made tokens while others wait."""
MOST_SECONDS = 1e15
"""Times are less than this, either way."""


class Request(NamedTuple):
    """A request: what the client called it, which is sent back; one of the methods; its parameters, checked so far.

    ``large`` says that reading it takes longer than others should wait.
    """

    id: int | str | None
    method: str
    params: Mapping[str, Any]
    large: bool = False


def read_request(text: str | bytes, methods: Methods = METHODS, values: int = MAX_VALUES) -> Request:
    """Read one message of at most so many values.

    Raises:
        ProtocolError: it is no request; ``request_id`` is set on the error if the message had one.
    """
    if isinstance(text, bytes):
        raise ProtocolError("a request is a text message, not a binary one.")
    if most_values(text.encode(errors="replace")) > values:
        raise ProtocolError(f"a request has at most {values} values.")
    try:
        document = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"the message is no JSON: {str(error)[:200]}.") from error
    if not isinstance(document, dict):
        raise ProtocolError(f"a request is a JSON object; found {type(document).__name__}.")
    name = document.pop("id", None)
    if not (name is None or isinstance(name, str) or (isinstance(name, int) and not isinstance(name, bool))):
        raise ProtocolError("a request's id is a number without fraction, a string, or left out.")
    try:
        return Request(name, *_checked(document, methods), len(text) > LARGE)
    except ProtocolError as error:
        error.request_id = name  # type: ignore[attr-defined]
        raise


def _checked(document: dict[str, Any], methods: Methods) -> tuple[str, dict[str, Any]]:
    method = document.pop("method", None)
    allowed = methods.get(method) if isinstance(method, str) else None
    if allowed is None:
        raise ProtocolError(f"the method is one of {', '.join(methods)}; found {str(method)[:40]!r}.")
    if unexpected := sorted(document.keys() - allowed):
        raise ProtocolError(f"{method} takes {sorted(allowed)}; found {unexpected[0][:40]!r}.")
    for key in ("t", "timeout"):
        value = 0 if document.get(key) is None else document[key]
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MOST_SECONDS:
            raise ProtocolError(f"{key} is a number of seconds; found {str(value)[:40]}.")
    seed = document.get("seed")
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 1 << 63):
        raise ProtocolError("seed is a number without fraction, from 0 to 2**63 - 1.")
    if "obs" in allowed and not isinstance(document.get("obs"), dict):
        raise ProtocolError(f"{method} needs obs, an object with an array a key.")
    if not isinstance(document.get("plan") or "", str):
        raise ProtocolError("plan is the name of one, or left out.")
    return str(method), document


def read_arrays(obs: Mapping[str, Any], specs: Mapping[str, ObservationSpec]) -> dict[str, Array]:
    """The arrays of an observation, by key, of the specified dtypes where they are lists; shapes are left to others.

    Of other keys nothing is read.

    Raises:
        ProtocolError: something is no array.
    """
    return {key: _array(key, one, specs[key].dtype) if key in specs else np.zeros(0) for key, one in obs.items()}


def read_frame(obs: Mapping[str, Any], specs: Mapping[str, ObservationSpec]) -> dict[str, Array | str]:
    """The same with the text ``task``, if it has one. Raises ProtocolError, also for what ``read_task`` refuses."""
    if TASK in specs or TASK not in obs:
        return dict(read_arrays(obs, specs))
    arrays = read_arrays({key: one for key, one in obs.items() if key != TASK}, specs)
    return {**arrays, TASK: read_task(obs[TASK])}


def read_task(task: Any) -> str:
    """The text of a client's task. Raises ProtocolError: it is none, or would take long to be made tokens."""
    if not isinstance(task, str):
        raise ProtocolError(f"a task is a text; found {type(task).__name__}.")
    if len(task) > LONGEST_TASK:
        raise ProtocolError(f"a task has at most {LONGEST_TASK} characters; found {len(task)}.")
    return task


def _array(key: str, value: Any, dtype: str) -> Array:
    if isinstance(value, dict):
        return _packed(key, value)
    try:
        array = np.asarray(value)
        if array.dtype.kind not in KINDS[np.dtype(dtype).kind]:
            of = "true and false" if dtype == "bool" else f"numbers that are {dtype}"
            raise ProtocolError(f"observation {key[:40]!r} must be lists of {of}.")
        if np.dtype(dtype).kind != "f" and array.size:
            low, high = (0, 1) if dtype == "bool" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
            if array.min() < low or array.max() > high:
                raise ProtocolError(f"observation {key[:40]!r} has a number that is no {dtype}.")
        with np.errstate(over="ignore"):  # what becomes infinite is refused as that
            return array.astype(dtype)
    except (ValueError, OverflowError) as error:
        raise ProtocolError(f"observation {key[:40]!r} is no array: {str(error)[:200]}.") from error


def _packed(key: str, value: dict[str, Any]) -> Array:
    """``{"dtype": "uint8", "shape": [96, 96, 3], "base64": "..."}``: little-endian, the last axis fastest."""
    try:
        dtype = DTYPES.get(str(value["dtype"]))  # a look-up: numpy would parse what else it is given as Python
        shape = tuple(value["shape"])
        if dtype is None or not all(type(n) is int and n >= 0 for n in shape):
            raise ProtocolError(f"observation {key[:40]!r} must be of integers or floats, with a shape that is one.")
        content = base64.b64decode(value["base64"], validate=True)
        array: Array = np.frombuffer(content, dtype).reshape(shape)
        return array.astype(dtype.newbyteorder("="))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        expected = "lists of numbers, or an object with dtype, shape and base64"
        raise ProtocolError(f"observation {key[:40]!r} must be {expected}: {str(error)[:200]}.") from error


def answer(request_id: int | str | None, outcome: Mapping[str, Any] | Exception) -> str:
    """The text of an answer: a result, or what went wrong."""
    if isinstance(outcome, Exception):
        return json.dumps({"id": request_id, "error": {"type": type(outcome).__name__, "message": str(outcome)}})
    return json.dumps({"id": request_id, "result": outcome}, allow_nan=False)


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_ESCAPED = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})


@dataclass(frozen=True)
class Metric:
    """One figure, with a sample for each set of labels.

    Attributes:
        name: after ``ttscompile_``; of a counter it ends with ``_total``.
        kind: ``counter``, ``gauge`` or ``histogram``.
        samples: labels and value; of a histogram those of its buckets, the last of which has all.
    """

    name: str
    kind: str
    help: str
    samples: Sequence[tuple[Mapping[str, str], float]]
    sum: float | None = None


def exposition(metrics: Sequence[Metric]) -> str:
    """The text of figures."""
    lines = list[str]()
    for each in metrics:
        name = f"ttscompile_{each.name}"
        lines += [f"# HELP {name} {each.help}", f"# TYPE {name} {each.kind}"]
        of_samples = name if each.sum is None else f"{name}_bucket"
        for labels, value in each.samples:
            inside = ",".join(f'{key}="{text.translate(_ESCAPED)}"' for key, text in labels.items())
            lines.append(f"{of_samples}{{{inside}}} {value!r}" if inside else f"{of_samples} {value!r}")
        if each.sum is not None:
            lines += [f"{name}_sum {each.sum!r}", f"{name}_count {each.samples[-1][1]!r}"]
    return "\n".join(lines) + "\n"


def of_statistics(statistics: ExecutorStatistics) -> list[Metric]:
    """What an executor did so far: its counts, and percentiles of what it measured."""
    labels = {"plan": statistics.plan, "identity": statistics.identity}
    found = [Metric("plan_info", "gauge", "The plan that the next call runs, and the artifact.", [(labels, 1)])]
    for name in COUNTS:
        found.append(
            Metric(f"{name}_total", "counter", f"See {name} in ExecutorStatistics.", [({}, getattr(statistics, name))])
        )
    for name, value in vars(statistics).items():
        if isinstance(value, Summary):
            samples = [({"quantile": each}, getattr(value, f"p{each[2:]:0<2}")) for each in ("0.5", "0.95", "0.99")]
            what = f"Percentiles of the last measurements; see {name} in ExecutorStatistics."
            found.append(Metric(name, "gauge", what, samples))
    return found
