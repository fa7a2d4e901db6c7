"""Graphs as JSON, for ``program.json`` in the artifact. Knows no torch; trusts nothing that it reads.

A graph is an object with ``inputs``, ``constants``, ``nodes`` and ``outputs``. Arguments that JSON has no form for are
objects with one key: ``{"ref": name}``, ``{"batch": multiple}``, ``{"enum": [kind, name]}``, ``{"float": "inf"}``.
``Node.source`` (a path on the machine of the author) is not written. Whether an operation exists is checked where it is
run, in ``ir.evaluate``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeAlias

from ttscompile.errors import ArtifactError

from .graph import GETITEM, Argument, Batch, Enum, Graph, Node, Ref, Size, TensorType

Json: TypeAlias = Any

MAX_NODES = 200_000
MAX_VALUES = 200_000
MAX_NAME = 512
MAX_RANK = 16
MAX_DEPTH = 3
MAX_ITEMS = 65_536
MAX_SIZE = 2**40
MAX_INT = 2**63

DTYPES = frozenset({"bool", "uint8", "int8", "int16", "int32", "int64", "float16", "bfloat16", "float32", "float64"})
ENUM_KINDS = frozenset({"dtype", "memory_format", "layout", "device"})

_OP = re.compile(r"aten\.[A-Za-z_][A-Za-z0-9_]*\.[A-Za-z_][A-Za-z0-9_]*")
_ENUM_NAME = re.compile(r"[A-Za-z0-9_:]{1,64}")
_UNUSUAL_FLOATS = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


def graph_to_json(graph: Graph) -> dict[str, Json]:
    """The JSON form of a graph: dictionaries, lists, strings and finite numbers only.

    Raises:
        ArtifactError: it holds something that ``graph_from_json`` would refuse; names it.
    """
    return {
        "inputs": [{"name": n, "type": _type_to_json(t)} for n, t in graph.inputs.items()],
        "constants": [{"name": n, "type": _type_to_json(t)} for n, t in graph.constants.items()],
        "nodes": [_node_to_json(node) for node in graph.nodes],
        "outputs": list(graph.outputs),
    }


def graph_from_json(document: Json) -> Graph:
    """The graph that ``graph_to_json`` wrote; exact but for ``Node.source``, which is empty.

    Raises:
        ArtifactError: an unknown, missing or ill-typed field, an operation that is not named like an ATen operation,
            two values of one name, or a value that is read before it is computed. Says where.
    """
    fields = _object(document, ("inputs", "constants", "nodes", "outputs"), "graph")
    defined: dict[str, int] = {}
    inputs = _values_from_json(fields["inputs"], "inputs", defined)
    constants = _values_from_json(fields["constants"], "constants", defined)
    nodes = []
    for i, item in enumerate(_list(fields["nodes"], MAX_NODES, "nodes")):
        where = f"nodes[{i}]"
        node = _node_from_json(item, where)
        for name in node.refs():
            if name not in defined:
                raise _error(f"{where}.args", "values computed before", f"%{name}")
        if node.op == GETITEM:
            _check_getitem(node, defined, where)
        _define(defined, node.name, len(node.types), where)
        nodes.append(node)
    outputs = tuple(
        _string(name, f"outputs[{i}]") for i, name in enumerate(_list(fields["outputs"], MAX_VALUES, "outputs"))
    )
    for i, name in enumerate(outputs):
        if name not in defined:
            raise _error(f"outputs[{i}]", "the name of a value", f"%{name}")
    return Graph(inputs=inputs, constants=constants, nodes=tuple(nodes), outputs=outputs)


def _type_to_json(type_: TensorType) -> Json:
    shape = [{"batch": n.multiple} if isinstance(n, Batch) else n for n in type_.shape]
    return {"dtype": type_.dtype, "shape": shape}


def _node_to_json(node: Node) -> Json:
    with _locating(f"node {node}"):
        return {
            "name": node.name,
            "op": node.op,
            "args": [_argument_to_json(a) for a in node.args],
            "kwargs": {name: _argument_to_json(a) for name, a in node.kwargs},
            "types": [_type_to_json(t) for t in node.types],
        }


def _argument_to_json(argument: Argument) -> Json:
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
    raise _error("argument", "None, bool, int, float, str, Batch, Ref, Enum or a tuple of them", repr(argument))


def _values_from_json(document: Json, where: str, defined: dict[str, int]) -> Mapping[str, TensorType]:
    values = {}
    for i, item in enumerate(_list(document, MAX_VALUES, where)):
        place = f"{where}[{i}]"
        fields = _object(item, ("name", "type"), place)
        name = _string(fields["name"], f"{place}.name")
        _define(defined, name, 1, place)
        values[name] = _type_from_json(fields["type"], f"{place}.type")
    return values


def _type_from_json(document: Json, where: str) -> TensorType:
    fields = _object(document, ("dtype", "shape"), where)
    dtype = fields["dtype"]
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise _error(f"{where}.dtype", f"one of {sorted(DTYPES)}", dtype)
    sizes = _list(fields["shape"], MAX_RANK, f"{where}.shape")
    return TensorType(tuple(_size_from_json(n, f"{where}.shape[{i}]") for i, n in enumerate(sizes)), dtype)


def _size_from_json(document: Json, where: str) -> Size:
    if isinstance(document, dict):
        return _batch_from_json(document, where)
    if type(document) is not int or not 0 <= document <= MAX_SIZE:
        raise _error(where, f'a size of 0..{MAX_SIZE} or {{"batch": multiple}}', document)
    return document


def _batch_from_json(document: Json, where: str) -> Batch:
    multiple = _object(document, ("batch",), where)["batch"]
    if type(multiple) is not int or not 1 <= multiple <= MAX_SIZE:
        raise _error(f"{where}.batch", f"a multiple of 1..{MAX_SIZE}", multiple)
    return Batch(multiple)


def _node_from_json(document: Json, where: str) -> Node:
    fields = _object(document, ("name", "op", "args", "kwargs", "types"), where)
    op = fields["op"]
    if not isinstance(op, str) or not (op == GETITEM or (len(op) <= MAX_NAME and _OP.fullmatch(op))):
        raise _error(f"{where}.op", "aten.NAME.OVERLOAD or getitem", op)
    args = _list(fields["args"], MAX_ITEMS, f"{where}.args")
    kwargs = fields["kwargs"]
    if not isinstance(kwargs, dict) or not all(isinstance(k, str) and k.isidentifier() for k in kwargs):
        raise _error(f"{where}.kwargs", "an object whose keys are identifiers", kwargs)
    types = _list(fields["types"], MAX_ITEMS, f"{where}.types")
    if not types:
        raise _error(f"{where}.types", "at least one type", types)
    return Node(
        name=_string(fields["name"], f"{where}.name"),
        op=op,
        args=tuple(_argument_from_json(a, f"{where}.args[{i}]") for i, a in enumerate(args)),
        kwargs=tuple((k, _argument_from_json(kwargs[k], f"{where}.kwargs.{k}")) for k in sorted(kwargs)),
        types=tuple(_type_from_json(t, f"{where}.types[{i}]") for i, t in enumerate(types)),
    )


def _argument_from_json(document: Json, where: str, depth: int = 0) -> Argument:
    if document is None or isinstance(document, bool):
        return document
    if isinstance(document, int):
        if not -MAX_INT <= document < MAX_INT:
            raise _error(where, "an integer of 64 bits", document)
        return document
    if isinstance(document, float):
        if not math.isfinite(document):
            raise _error(where, 'a finite number, or {"float": "inf"}', document)
        return document
    if isinstance(document, str):
        if len(document) > MAX_NAME:
            raise _error(where, f"at most {MAX_NAME} characters", document)
        return document
    if isinstance(document, list):
        if depth == MAX_DEPTH:
            raise _error(where, f"lists at most {MAX_DEPTH} deep", "a deeper one")
        items = _list(document, MAX_ITEMS, where)
        return tuple(_argument_from_json(item, f"{where}[{i}]", depth + 1) for i, item in enumerate(items))
    if isinstance(document, dict) and len(document) == 1:
        (tag,) = document
        if tag == "ref":
            return Ref(_string(document[tag], f"{where}.ref"))
        if tag == "batch":
            return _batch_from_json(document, where)
        if tag == "enum":
            return _enum_from_json(document[tag], f"{where}.enum")
        if tag == "float" and isinstance(document[tag], str) and document[tag] in _UNUSUAL_FLOATS:
            return _UNUSUAL_FLOATS[document[tag]]
    raise _error(where, 'a constant, a list, or an object with the one key "ref", "batch", "enum" or "float"', document)


def _enum_from_json(document: Json, where: str) -> Enum:
    match document:
        case [str(kind), str(name)] if kind in ENUM_KINDS and _ENUM_NAME.fullmatch(name):
            return Enum(kind, name)
    raise _error(where, f"[kind, name] with a kind of {sorted(ENUM_KINDS)}", document)


def _check_getitem(node: Node, defined: Mapping[str, int], where: str) -> None:
    match node.args:
        case (Ref(name), int(index)) if not node.kwargs and 0 <= index < defined[name]:
            return
    raise _error(where, "getitem of a value and the number of one of its results", str(node))


def _define(defined: dict[str, int], name: str, results: int, where: str) -> None:
    if name in defined:
        raise _error(f"{where}.name", "a name of its own", f"{name!r} a second time")
    defined[name] = results


def _object(document: Json, keys: tuple[str, ...], where: str) -> dict[str, Json]:
    if not isinstance(document, dict) or set(document) != set(keys):
        found = sorted(map(str, document)) if isinstance(document, dict) else document
        raise _error(where, f"an object with exactly the keys {sorted(keys)}", found)
    return document


def _list(document: Json, most: int, where: str) -> list[Json]:
    if not isinstance(document, list) or len(document) > most:
        found = f"a list of {len(document)}" if isinstance(document, list) else document
        raise _error(where, f"a list of at most {most} items", found)
    return document


def _string(document: Json, where: str) -> str:
    if not isinstance(document, str) or not 1 <= len(document) <= MAX_NAME or not document.isprintable():
        raise _error(where, f"a name of 1..{MAX_NAME} printable characters", document)
    return document


@contextmanager
def _locating(where: str) -> Iterator[None]:
    try:
        yield
    except ArtifactError as error:
        raise ArtifactError(f"{where}: {error}") from None


def _error(where: str, expected: str, found: object) -> ArtifactError:
    shown = found if isinstance(found, str) else repr(found)
    shown = shown if len(shown) <= 120 else shown[:117] + "..."
    return ArtifactError(
        f"the graph's {where} is not valid: expected {expected}; found {shown}."
        " The artifact was damaged or written by another version: convert the policy again."
    )
