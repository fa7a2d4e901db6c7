"""Push-T as a policy of images saw it in training: gym-pusht's own small picture, and where the agent is."""

from __future__ import annotations

import numpy as np

from . import Frame
from .pusht import PushT

SIZE = 64
"""Pixels of a side; a pixel is 8 of the world's."""


class PushTPixels(PushT):
    """See ``PushT``, from which only what is observed differs."""

    title = "Push-T from pixels"

    def observe(self) -> Frame:
        """``observation.image``, float32 ``[3, SIZE, SIZE]`` of 0..1, and ``observation.state`` ``[2]``, the agent."""
        world = self._gym.unwrapped
        image = world._get_img(world._draw(), SIZE, SIZE)  # what gym-pusht observes, drawn only when it is looked at
        pixels = np.moveaxis(image, -1, 0).astype(np.float32) / 255
        return {"observation.image": pixels, "observation.state": self.rest()}


ENVIRONMENT = PushTPixels
