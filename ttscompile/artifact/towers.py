"""Records of the manifest about image encoders, and scenes, that can compute some of their tokens."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from ..core.rules import OMITTED, Positive
from ..ir.graph import TensorType


@dataclass(frozen=True)
class TokensRecord:
    """The tokens of a frame piece that is a vision transformer, or of a scene, and what is kept of them between calls.

    Attributes:
        tokens: T.
        fixed: how many tokens, the first ones, are of no patch.
        patch: height and width of a patch in pixels; the other tokens are of the patches, row by row. Of a scene a row
            of its sequence is one: 1, and how many numbers it has.
        kept: type ``[T, ...]`` of each array that is kept, by the input of ``tokens_00`` that reads it. The last
            outputs of ``tokens_00`` are the same arrays with new rows, in this order.
        words: of a scene, the tokens that no picture changes, ascending. They are computed with any other.
    """

    tokens: Positive
    fixed: int
    patch: tuple[Positive, Positive]
    kept: Mapping[str, TensorType]
    words: tuple[int, ...] = field(default=(), metadata=OMITTED)
