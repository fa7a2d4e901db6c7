"""Records to JSON by the types of their fields, and strictly back.

A frozen dataclass is an object with a member a field, but for those that ``core.rules.OMITTED`` leaves out; a mapping
is an object, a tuple a list, an enumeration its value. A vector of float32 is a list of numbers; another array is
``{"dtype", "shape", "values"}``. Floats are written as the shortest decimal of the double that equals the float32, so
that they come back bit by bit. A tensor type has the sizes that depend on the batch as text:
``{"dtype": "float32", "shape": ["B", 16, 64]}``.

What a type does not say stands beside it as a ``core.rules.Rule``.
"""

import enum
import math
import re
import types
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from ..core.coercion import Array
from ..core.rules import MAX_RANK, DType
from ..errors import ArtifactError, SpecError
from ..ir.graph import Batch, Size, TensorType
from .strict_json import REMEDY, Value

Record = TypeVar("Record")
Reader = Callable[[Value], Any]
"""Makes of a JSON value what it says, of one type; raises ArtifactError where it is of another."""
_PLAIN: Mapping[Any, Reader] = {
    int: Value.integer,
    float: Value.number,
    str: Value.text,
    bool: Value.boolean,
    Any: lambda value: value.data,
}
_BATCH = re.compile(r"(?:([1-9][0-9]{0,8})\*)?B")


def to_json(value: Any) -> Any:
    """Plain JSON values; the order of fields and mappings is kept."""
    if isinstance(value, TensorType):
        return {"dtype": value.dtype, "shape": [str(n) if isinstance(n, Batch) else n for n in value.shape]}
    if is_dataclass(value):
        told = (
            one for one in fields(value) if not one.metadata.get("omitted") or getattr(value, one.name) != one.default
        )
        return {field.name: to_json(getattr(value, field.name)) for field in told}
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, np.ndarray):
        if value.ndim == 1 and value.dtype == np.float32:
            return value.tolist()
        return {"dtype": str(value.dtype), "shape": list(value.shape), "values": value.ravel().tolist()}
    return value


def from_json(kind: type[Record], value: Value) -> Record:
    """Inverse of ``to_json`` for a frozen dataclass. Integers are not negative where no rule says otherwise."""
    return cast(Record, read_as(kind, value))


def read_as(kind: Any, value: Value) -> Any:
    """A value of any type that a field of a record may have; see ``from_json``."""
    return _reader(kind)(value)


@cache
def _reader(kind: Any) -> Reader:
    """What reads values of a type. A manifest has a thousand, of some dozen types, so each is looked into once."""
    origin, arguments = _origin(kind), get_args(kind)
    if origin is Annotated:
        return _held_to(arguments[1:], _reader(arguments[0]))
    if origin in (Union, types.UnionType):
        return _either(arguments)
    if origin is Literal:
        return lambda value: value.text(*arguments)
    if origin is np.ndarray:
        return _array
    if origin is tuple:
        return _tuple(arguments)
    if origin is not None and issubclass(origin, Mapping):
        return _mapping(*map(_reader, arguments))
    if kind is TensorType:
        return _tensor_type
    if isinstance(kind, enum.EnumMeta):
        members = {str(one.value): one for one in cast(type[enum.Enum], kind)}
        return lambda value: members[value.text(*members)]
    return _record(kind) if is_dataclass(kind) else _PLAIN[kind]


def _origin(kind: Any) -> Any:
    """As ``get_origin``; from Python 3.12 on numpy 2.5 has ``NDArray`` as an alias that stands for another type."""
    origin = get_origin(kind)
    return get_origin(getattr(origin, "__value__", None)) or origin


def _held_to(rules: tuple[Any, ...], read: Reader) -> Reader:
    def reader(value: Value) -> Any:
        found = read(value)
        for rule in rules:
            if not rule.holds(found):
                value.fail(rule.expected)
        return found

    return reader


def _record(kind: Any) -> Reader:
    hints = get_type_hints(kind, include_extras=True)
    omitted = {field.name for field in fields(kind) if field.metadata.get("omitted")}

    def reader(value: Value) -> Any:
        left_out = omitted - value.members().keys() if omitted else omitted
        members = value.keys(*(field.name for field in fields(kind) if field.name not in left_out))
        read = {name: read_as(hints[name], member) for name, member in members.items()}
        try:
            return kind(**read)
        except SpecError as error:
            raise ArtifactError(f"{value.path}: {error} {REMEDY}") from error

    return reader


def _mapping(key: Reader, item: Reader) -> Reader:
    return lambda value: {key(Value(name, value.path)): item(one) for name, one in value.members().items()}


def _either(kinds: tuple[Any, ...]) -> Reader:
    """One of several types, told apart by what JSON has: null, a list, or something else."""
    rest = [kind for kind in kinds if kind is not types.NoneType]
    listed = [kind for kind in rest if _origin(kind) in (tuple, np.ndarray)]
    single = [kind for kind in rest if kind not in listed]

    def reader(value: Value) -> Any:
        if value.data is None and types.NoneType in kinds:
            return None
        return read_as((listed if listed and (isinstance(value.data, list) or not single) else single)[0], value)

    return reader


def _tuple(kinds: tuple[Any, ...]) -> Reader:
    if kinds[1:] == (...,):
        each = _reader(kinds[0])
        return lambda value: tuple(map(each, value.items()))

    def reader(value: Value) -> Any:
        items = value.items()
        if len(items) != len(kinds):
            value.fail(f"a list of {len(kinds)}")
        return tuple(map(read_as, kinds, items))

    return reader


def _tensor_type(value: Value) -> TensorType:
    parts = value.keys("dtype", "shape")
    return TensorType(tuple(map(_size, parts["shape"].items(MAX_RANK))), read_as(DType, parts["dtype"]))


def _array(value: Value) -> Array:
    if isinstance(value.data, list):
        return _vector(value, "float32")
    members = value.keys("dtype", "shape", "values")
    shape = tuple(item.integer() for item in members["shape"].items(MAX_RANK))
    array = _vector(members["values"], members["dtype"].text("float32", "int64"))
    if array.size != math.prod(shape):
        value.fail(f"{math.prod(shape)} numbers, for the shape {list(shape)}")
    try:
        return array.reshape(shape)
    except ValueError:  # their product overflows, though one of them is 0
        members["shape"].fail("sizes that an array can have")


def _vector(value: Value, dtype: str) -> Array:
    if dtype == "int64":
        return np.array([item.integer(None) for item in value.items()], np.int64)
    numbers = [item.number() for item in value.items()]
    with np.errstate(over="ignore"):
        array = np.array(numbers, np.float32)
    for item, number, kept in zip(value.items(), numbers, array.tolist(), strict=True):
        if kept != number:
            item.fail("a number that float32 holds exactly")
    return array


def _size(value: Value) -> Size:
    if isinstance(value.data, str):
        match = _BATCH.fullmatch(value.data)
        if match is None or match[1] == "1":
            value.fail("a size: an integer, 'B' or 'n*B'")
        return Batch(int(match[1] or 1))
    return value.integer()
