"""What a field must be beside its type: ``Annotated[str, Rule("64 hexadecimal digits", ...)]``.

A reader of records that somebody else wrote (``artifact.typed_json``) holds every value against the rules of its field.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any


@dataclass(frozen=True)
class Rule:
    """One rule.

    Attributes:
        expected: in words, after "expected".
        holds: of a value of the field's type; true or a match where it is met.
    """

    expected: str
    holds: Callable[[Any], object]


OMITTED = {"omitted": True}
"""Metadata of a field that records leave out where it has its default."""

MAX_RANK = 16
"""Sizes of a shape that somebody else wrote: the product of thousands takes minutes, and cannot be printed."""

_DTYPES = ("float32", "float64", "float16", "int64", "int32", "int16", "int8", "uint8", "bool")

DType = Annotated[str, Rule(f"one of {', '.join(_DTYPES)}", _DTYPES.__contains__)]
LOOP_NAME = Rule("a name of lower-case letters, digits and + . -", re.compile(r"[a-z0-9][a-z0-9+.-]{0,63}").fullmatch)
LoopName = Annotated[str, LOOP_NAME]
NotNegative = Annotated[float, Rule("a number that is not negative", lambda x: x >= 0)]
Hertz = Annotated[float, Rule("a positive number", lambda x: x > 0)]
Positive = Annotated[int, Rule("a 64-bit integer of at least 1", lambda n: n >= 1)]
Shape = Annotated[tuple[Positive, ...], Rule(f"at most {MAX_RANK} sizes", lambda sizes: len(sizes) <= MAX_RANK)]
Sha256 = Annotated[str, Rule("64 hexadecimal digits", re.compile(r"[0-9a-f]{64}").fullmatch)]
Share = Annotated[float, Rule("a number in 0..1", lambda x: 0 <= x <= 1)]
