"""Records of the manifest about towers that compute some of their tokens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..core.rules import NotNegative, Positive, Share
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


@dataclass(frozen=True)
class ReuseRecord:
    """How tokens are reused from frame to frame, and what that did to the actions on recorded episodes.

    Attributes:
        threshold: a patch has changed where its pixels, as the tower reads them, differ by more than this on average
            from those that its token was last computed for.
        refresh: of so many new frames of a camera one is computed whole.
        computed: share of the tokens of new frames that were computed, on episodes that settings were not chosen on.
        error: mean difference of the executed actions from those with all tokens and the same noise, on the same.
        other_noise: the same for two calls on one observation with different noise.
        calls: how many calls these are.
    """

    threshold: NotNegative
    refresh: Positive
    computed: Share
    error: NotNegative
    other_noise: NotNegative
    calls: Positive
