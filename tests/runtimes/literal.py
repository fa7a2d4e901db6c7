"""Design, section 2, one stream at a time, with dictionaries: what everything else here is compared with."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ttscompile import Source

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Toy:
    """A policy as functions of one stream: ``stem(x, k)``, ``block(h, k, b)``, ``advance(h, x, k)``."""

    groups: tuple[int, ...]
    stem: Callable[[Array, int], Array]
    block: Callable[[Array, int, int], Array]
    advance: Callable[[Array, Array, int], Array]


@dataclass
class Episode:
    """One stream's episode; ``rollout`` is all that is left between calls."""

    toy: Toy
    rollout: dict[tuple[int, int], Array] = field(default_factory=dict)

    def call(self, x: Array, plan: npt.NDArray[np.int8]) -> Array:
        forward: dict[int, Array] = {}
        timestep: dict[int, Array] = {}
        for k, row in enumerate(plan):
            h = self.toy.stem(x, k)
            for b, source in enumerate(row):
                group = self.toy.groups[b]
                if source == Source.COMPUTE:
                    residual = self.toy.block(h, k, b)
                    forward[group] = timestep[b] = self.rollout[k, b] = residual
                elif source == Source.FORWARD:
                    residual = forward[group]
                elif source == Source.TIMESTEP:
                    residual = timestep[b]
                else:
                    residual = self.rollout[k, b]
                h = h + residual
            x = self.toy.advance(h, x, k)
        return x
