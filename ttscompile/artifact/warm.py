"""What was measured of calls that begin with the chunk of the call before."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.rules import NotNegative, Positive


@dataclass(frozen=True)
class WarmRecord:
    """How many steps a call needs that begins with the chunk before, as measured on recorded episodes.

    A distance is that of the executed actions from those of a dense call with other noise, over the distance of two
    dense calls with different noise: 1 where the chunk before has left no trace.

    Attributes:
        last_steps: of the loop, which such a call computes.
        same: the distance after the call before.
        changed: the distance after a call of another episode, as if the world had changed between two calls.
        allowed: the largest distance that was allowed.
        calls: how many calls were measured.
    """

    last_steps: Positive
    same: NotNegative
    changed: NotNegative
    allowed: NotNegative
    calls: Positive
