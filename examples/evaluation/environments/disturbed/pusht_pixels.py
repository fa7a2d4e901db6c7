"""Push-T from pixels: with a red block, where all demonstrations have a grey one, and five times as long."""

from __future__ import annotations

from collections.abc import Sequence

from ..pusht_pixels import PushTPixels
from .pusht import GOALS, PushTLong

RED = (205, 92, 92, 255)


class PushTPixelsRed(PushTPixels):
    """See ``PushTPixels``, from which only the colour differs."""

    title = "Push-T from pixels, the block red"

    def reset(self, seed: int, state: Sequence[float] | None = None) -> None:
        """Start the episode of this seed."""
        super().reset(seed, state)
        for shape in self._gym.unwrapped.block.shapes:
            shape.color = RED


class PushTPixelsLong(PushTLong, PushTPixels):
    """See ``PushTLong``; what is observed are pictures."""

    title = f"Push-T from pixels, {GOALS} goals in a row"


DISTURBED = {"long": PushTPixelsLong, "red": PushTPixelsRed}
