"""What a loop begins with that is the rest of a longer one: a warm start."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import SpecError
from .rules import Positive


@dataclass(frozen=True)
class Start:
    """What the rest of a longer loop begins with.

    Attributes:
        skipped: steps of the longer loop that come before it.
        action: share of the action, normalised, in the sample that it begins with.
        noise: share of noise.
    """

    skipped: Positive
    action: float
    noise: float

    def __post_init__(self) -> None:
        if not all(0 <= share <= 1 for share in (self.action, self.noise)):
            raise SpecError(f"the shares of a start must be 0 to 1; found {self.action} and {self.noise}.")

    def told(self, steps: int) -> str:
        """For people, with the number of steps that follow: ``the last 3 of 16 steps``."""
        return f"the last {steps} of {self.skipped + steps} steps"
