"""A call as one differentiable formula of its gates: what their gradients are compared with."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ttscompile import Source
from ttscompile.runtimes.reference.model import Contexts, ReferenceModel


def everything_recorded(
    model: ReferenceModel,
    contexts: Contexts,
    initial: Tensor,
    steps: Tensor | None,
    gates: Tensor,
    rollout: Mapping[tuple[int, int], Tensor],
) -> Tensor:
    """The sample ``[B, T, D]``: all candidates of all cells, recorded, mixed by the gates ``[B, K, blocks, 4]``."""
    carried = model.sampler.begin(initial)
    forward: dict[int, Tensor] = {}
    timestep: dict[int, Tensor] = {}
    zero = torch.zeros(())
    for k in range(model.steps):
        h = model.stem(carried.sample, k, contexts)
        for b, group in enumerate(model.groups):
            g = [gates[:, k, b, source].reshape(-1, 1, 1) for source in Source]
            computed = model.block(b, k, h, contexts)
            old_forward, old_timestep = forward.get(group, zero), timestep.get(b, zero)
            h = h + g[0] * computed + g[1] * old_forward + g[2] * old_timestep + g[3] * rollout.get((k, b), zero)
            forward[group] = g[0] * computed + (1 - g[0]) * old_forward
            timestep[b] = g[0] * computed + (1 - g[0]) * old_timestep
        carried = model.sampler.advance(carried, model.tail(h, k, contexts), None if steps is None else steps[k], k)
    return carried.sample
