"""Graphs as JSON, for ``program.json``. Knows no torch; trusts nothing that it reads.

A graph is an object with ``inputs``, ``constants``, ``nodes`` and ``outputs``. Arguments that JSON has no form for are
objects with one key: ``{"ref": name}``, ``{"batch": multiple}``, ``{"enum": [kind, name]}``, ``{"float": "inf"}``.
``Node.source`` (a path on the machine of the author) is not written. Whether an operation exists is checked where it is
run, in ``ir.evaluate``.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

from ..core.rules import MAX_RANK
from ..errors import ArtifactError
from ..ir.graph import GETITEM, Argument, Batch, Enum, Graph, Node, Ref, TensorType
from .strict_json import Value

MAX_NAME = 512
MAX_DEPTH = 3
MAX_ITEMS = 65_536
MAX_SIZE = 2**40

DTYPES = ("bool", "uint8", "int8", "int16", "int32", "int64", "float16", "bfloat16", "float32", "float64")
ENUM_KINDS = frozenset({"dtype", "memory_format", "layout", "device"})

_OP = re.compile(r"aten\.[A-Za-z_][A-Za-z0-9_]*\.[A-Za-z_][A-Za-z0-9_]*")
_ENUM_NAME = re.compile(r"[A-Za-z0-9_:]{1,64}")
_UNUSUAL_FLOATS = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


def graph_to_json(graph: Graph) -> dict[str, Any]:
    """The JSON form of a graph: dictionaries, lists, strings and finite numbers only."""
    return {
        "inputs": [{"name": n, "type": _type_to_json(t)} for n, t in graph.inputs.items()],
        "constants": [{"name": n, "type": _type_to_json(t)} for n, t in graph.constants.items()],
        "nodes": [_node_to_json(node) for node in graph.nodes],
        "outputs": list(graph.outputs),
    }


def graph_from_json(document: Value) -> Graph:
    """The graph that ``graph_to_json`` wrote; exact but for ``Node.source``, which is empty. Errors say where."""
    members = document.keys("inputs", "constants", "nodes", "outputs")
    results: dict[str, int] = {}
    inputs = _typed_names(members["inputs"], results)
    constants = _typed_names(members["constants"], results)
    nodes = []
    for item in members["nodes"].items():
        parts = item.keys("name", "op", "args", "kwargs", "types")
        node = _node(parts)
        unknown = [name for name in node.refs() if name not in results]
        if unknown:
            item.fail(f"values computed before (unknown: %{unknown[0]})")
        if node.op == GETITEM and not _is_getitem(node, results):
            item.fail("getitem of a value and the number of one of its results")
        _define(results, parts["name"], len(node.types))
        nodes.append(node)
    outputs = members["outputs"].items()
    for output in outputs:
        if _name(output) not in results:
            output.fail("the name of a value")
    return Graph(inputs, constants, tuple(nodes), tuple(output.data for output in outputs))


def _type_to_json(kind: TensorType) -> dict[str, Any]:
    return {"dtype": kind.dtype, "shape": [_argument_to_json(n) for n in kind.shape]}


def _node_to_json(node: Node) -> dict[str, Any]:
    try:
        return {
            "name": node.name,
            "op": node.op,
            "args": [_argument_to_json(a) for a in node.args],
            "kwargs": {name: _argument_to_json(a) for name, a in node.kwargs},
            "types": [_type_to_json(t) for t in node.types],
        }
    except TypeError as error:
        raise ArtifactError(f"node {node}: {error} This is an error in ttscompile; please report it.") from None


def _argument_to_json(argument: Argument) -> Any:
    if argument is None or type(argument) in (bool, int, str):
        return argument
    if type(argument) is float:
        return argument if math.isfinite(argument) else {"float": repr(argument)}
    if isinstance(argument, Ref):
        return {"ref": argument.name}
    if isinstance(argument, Batch):
        return {"batch": argument.multiple}
    if isinstance(argument, Enum):
        return {"enum": [argument.kind, argument.name]}
    if type(argument) is tuple:
        return [_argument_to_json(item) for item in argument]
    raise TypeError(f"expected None, bool, int, float, str, Batch, Ref, Enum or a tuple of them; found {argument!r}.")


def _typed_names(value: Value, results: dict[str, int]) -> dict[str, TensorType]:
    typed = {}
    for item in value.items():
        members = item.keys("name", "type")
        typed[_define(results, members["name"], 1)] = _type(members["type"])
    return typed


def _define(results: dict[str, int], name: Value, count: int) -> str:
    if _name(name) in results:
        name.fail("a name that no other value has")
    results[name.data] = count
    return str(name.data)


def _type(value: Value) -> TensorType:
    members = value.keys("dtype", "shape")
    sizes = members["shape"].items(MAX_RANK)
    shape = tuple(_batch(n) if isinstance(n.data, dict) else n.integer(0, MAX_SIZE) for n in sizes)
    return TensorType(shape, members["dtype"].text(*DTYPES))


def _batch(value: Value) -> Batch:
    return Batch(value.keys("batch")["batch"].integer(1, MAX_SIZE))


def _node(members: Mapping[str, Value]) -> Node:
    op = members["op"].text()
    if op != GETITEM and (len(op) > MAX_NAME or not _OP.fullmatch(op)):
        members["op"].fail("aten.NAME.OVERLOAD or getitem")
    kwargs = members["kwargs"].members()
    if not all(key.isidentifier() for key in kwargs):
        members["kwargs"].fail("an object whose keys are identifiers")
    types = members["types"].items(MAX_ITEMS)
    if not types:
        members["types"].fail("at least one type")
    return Node(
        name=_name(members["name"]),
        op=op,
        args=tuple(_argument(item) for item in members["args"].items(MAX_ITEMS)),
        kwargs=tuple((key, _argument(kwargs[key])) for key in sorted(kwargs)),
        types=tuple(map(_type, types)),
    )


def _argument(value: Value, depth: int = 0) -> Argument:
    match value.data:
        case None | bool():
            return value.data
        case int():
            return value.integer(None)
        case float():
            return value.number()
        case str() if len(value.data) <= MAX_NAME:
            return value.data
        case list() if depth < MAX_DEPTH:
            return tuple(_argument(item, depth + 1) for item in value.items(MAX_ITEMS))
        case {"ref": _}:
            return Ref(_name(value.keys("ref")["ref"]))
        case {"batch": _}:
            return _batch(value)
        case {"enum": _}:
            return _enum(value.keys("enum")["enum"])
        case {"float": _}:
            return _UNUSUAL_FLOATS[value.keys("float")["float"].text(*_UNUSUAL_FLOATS)]
    value.fail(
        f"a constant of at most {MAX_NAME} characters, lists at most {MAX_DEPTH} deep, or an object with the one key"
        ' "ref", "batch", "enum" or "float"'
    )


def _enum(value: Value) -> Enum:
    match value.data:
        case [str(kind), str(name)] if kind in ENUM_KINDS and _ENUM_NAME.fullmatch(name):
            return Enum(kind, name)
    value.fail(f"[kind, name] with a kind of {sorted(ENUM_KINDS)}")


def _is_getitem(node: Node, results: dict[str, int]) -> bool:
    match node.args:
        case (Ref(name), int(index)):
            return not node.kwargs and 0 <= index < results[name]
    return False


def _name(value: Value) -> str:
    name = value.text()
    if not 1 <= len(name) <= MAX_NAME or not name.isprintable():
        value.fail(f"a name of 1..{MAX_NAME} printable characters")
    return name
