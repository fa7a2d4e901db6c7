"""Records of the manifest about image encoders that can compute some of their tokens."""

from collections.abc import Mapping
from dataclasses import dataclass

from ..core.rules import Positive
from ..ir.graph import TensorType


@dataclass(frozen=True)
class TokensRecord:
    """The tokens of a frame piece that is a vision transformer, and what is kept of them from frame to frame.

    Attributes:
        tokens: T.
        fixed: how many tokens, the first ones, are of no patch.
        patch: height and width of a patch in pixels; the other tokens are of the patches, row by row.
        kept: type ``[T, ...]`` of each array that is kept, by the input of ``tokens_00`` that reads it. The last
            outputs of ``tokens_00`` are the same arrays with new rows, in this order.
    """

    tokens: Positive
    fixed: int
    patch: tuple[Positive, Positive]
    kept: Mapping[str, TensorType]
