"""What one cell of the lattice adds and writes: ``docs/design.md`` section 2, literally."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.core.lattice import BoolArray, Source
from ttscompile.errors import IllegalPlanError
from ttscompile.ir.graph import TensorType


@dataclass(frozen=True)
class RolloutCache:
    """``rollout[k, b]`` of every stream: what a call leaves for the next one of the episode.

    Attributes:
        residuals: by ``(k, b)``, each of the residual's type, detached; holds rubbish for streams that never computed.
        written: bool ``[B, K, blocks]``; which entries a call of the episode has computed.
    """

    residuals: Mapping[tuple[int, int], Tensor]
    written: BoolArray


@dataclass
class Caches:
    """The three caches during a call, for all streams at once; when it starts there is what earlier calls left.

    Attributes:
        rollout: by step and block.
        forward: by group; empty when the call starts.
        timestep: by block; empty when the call starts.
    """

    rollout: dict[tuple[int, int], Tensor]
    forward: dict[int, Tensor] = field(default_factory=dict)
    timestep: dict[int, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Cell:
    """One cell for all streams: block b at step k.

    Attributes:
        group: the block's FORWARD group.
        plan: int8 ``[B]``, the source of each stream.
        gates: float32 ``[B, 4]``, the same one-hot, with or without a gradient.
        type: of the residual.
    """

    k: int
    b: int
    group: int
    plan: npt.NDArray[np.int8]
    gates: Tensor
    type: TensorType

    def wants(self, source: Source) -> bool:
        """Whether a stream takes its residual from here; or the gates want a gradient, and so all candidates."""
        return self.gates.requires_grad or bool((self.plan == source).any())

    def gate(self, source: Source) -> Tensor:
        """The gate of each stream, shaped to be multiplied with a residual."""
        shape = [1] * len(self.type.shape)
        shape[stream_axis(self.type)] = -1
        return self.gates[:, source].reshape(shape)

    def written(self, computed: Tensor, old: Tensor | None) -> Tensor:
        """A cache entry after this cell: computed where a stream computes, as it was elsewhere."""
        if old is None:
            return computed
        gate = self.gate(Source.COMPUTE)  # whose gradient has a part of what later steps read
        return gate * computed + (1 - gate) * old if gate.requires_grad else torch.where(gate == 1, computed, old)


def reuse(cell: Cell, computed: Tensor | None, caches: Caches) -> Tensor:
    """What one cell adds to the residual stream; writes the caches of the streams that compute it.

    ``computed`` is right for these, and where gates train for the others too; None if nobody needs it.
    """
    forward, timestep = caches.forward.get(cell.group), caches.timestep.get(cell.b)
    rollout = caches.rollout.get((cell.k, cell.b))
    if computed is not None and cell.wants(Source.COMPUTE):
        caches.forward[cell.group] = cell.written(computed, forward)
        caches.timestep[cell.b] = cell.written(computed, timestep)
        caches.rollout[cell.k, cell.b] = cell.written(computed.detach(), rollout)
    candidates = zip(Source, (computed, forward, timestep, rollout), strict=True)
    added = [cell.gate(s) * c for s, c in candidates if c is not None and cell.wants(s)]
    return torch.stack(added).sum(0) if len(added) > 1 else added[0]


def stream_axis(kind: TensorType) -> int:
    """The axis of the streams in a residual. Raises IllegalPlanError: there is none."""
    if kind.batch_axis is None:
        problem = f"the residual stream has type {kind}, without an axis for the streams"
        raise IllegalPlanError(f"{problem}: plans cannot differ by stream.")
    return kind.batch_axis
