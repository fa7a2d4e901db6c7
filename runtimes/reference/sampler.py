"""The sampler's step with torch, plain and differentiable: what is carried from step to step, and how it moves on."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ttscompile.core.correction import HISTORY, Correction
from ttscompile.core.spec import SamplerTable
from ttscompile.runtimes.inpainting import Known


class Carried(NamedTuple):
    """What the sampler carries from one step to the next.

    Attributes:
        sample: ``[B, T, D]``.
        memory: the sampler's S memories, ``[B, S, T, D]``.
        history: of the correction, ``[B, 4 T, D]``.
    """

    sample: Tensor
    memory: Tensor
    history: Tensor


class TorchSampler:
    """The sampler of a policy, by its table."""

    def __init__(self, table: SamplerTable) -> None:
        self._table = table

    def begin(self, initial: Tensor) -> Carried:
        """What is carried to step 0: the sample ``[B, T, D]``, and zeros."""
        streams, horizon, channels = initial.shape
        memory = initial.new_zeros(streams, self._table.memories, horizon, channels)
        return Carried(initial, memory, initial.new_zeros(streams, HISTORY * horizon, channels))

    def advance(
        self,
        carried: Carried,
        prediction: Tensor,
        noise: Tensor | None,
        k: int,
        correction: Correction | None = None,
        condition: Tensor | None = None,
    ) -> Carried:
        """What is carried to step k + 1 (``core.spec.SamplerTable`` has the formula).

        Args:
            carried: to step k.
            prediction: the network's output at step k, ``[B, T, D]``.
            noise: the draw used at step k, ``[B, T, D]``; None if the sampler is deterministic.
            k: step.
            correction: of the sampler's steps; None for none.
            condition: what the correction reads of the observation, ``[B, N]``; None if it reads nothing.
        """
        table, (sample, memory, history) = self._table, carried
        row = {name: float(getattr(table, name)[k]) for name in table.COLUMNS}
        clean = row["sample_to_x0"] * sample + row["out_to_x0"] * prediction
        if table.clip is not None:
            clean = clean.clamp(-table.clip, table.clip)
        following = row["x0_to_next"] * clean + row["sample_to_next"] * sample + row["out_to_next"] * prediction
        for s in range(table.memories):
            following = following + float(table.memory_to_next[k, s]) * memory[:, s]
        if noise is not None:
            following = following + row["noise_to_next"] * noise
        if table.memories:
            terms = torch.cat([torch.stack([clean, sample, prediction], 1), memory], 1)
            memory = torch.einsum("sr,brtd->bstd", torch.from_numpy(table.to_memory[k].copy()), terms)
        uncorrected = Carried(following, memory, history)
        if correction is None:
            return uncorrected
        weights, bias = torch.tensor(correction.weights[k]), torch.tensor(correction.bias[k])
        read = sample.new_zeros(len(sample), 0)
        if condition is not None and correction.reads:
            read = condition @ torch.tensor(correction.reading)
            bias = bias + torch.einsum("bf,fdt->dbt", read, torch.tensor(correction.observed[:, k]))
        if (j := correction.landings.get(k)) is not None:
            layers = [torch.tensor(array[j]) for array in (correction.inner, correction.middle, correction.outer)]
            bias = bias + jump(layers, read, history)
        return self.bounded(correct(carried, prediction, uncorrected, weights, bias, bool(correction.anchors[k])), k)

    def bounded(self, corrected: Carried, k: int) -> Carried:
        """What is carried to step k + 1, corrected: after the last step it is clipped where the sampler bounds it."""
        bound = self._table.bound if k + 1 == self._table.steps else None
        return corrected if bound is None else corrected._replace(sample=corrected.sample.clamp(-bound, bound))


def features(carried: Carried, prediction: Tensor) -> Tensor:
    """What the correction of a step is linear in, ``[D, B, 6 T]``: see ``core.correction``."""
    return torch.cat([carried.sample, prediction, carried.history], dim=1).permute(2, 0, 1)


def jump(layers: Sequence[Tensor], read: Tensor, history: Tensor) -> Tensor:
    """What a jump adds to the sample, ``[D, B, T]``: see ``core.correction``.

    Args:
        layers: inner, middle and outer, each with the row that is added last.
        read: of the condition, ``[B, F]``.
        history: after the jump's anchor, ``[B, 4 T, D]``.
    """
    streams, width, dimensions = history.shape
    added = through(layers, torch.cat([read, history.transpose(1, 2).reshape(streams, -1)], 1))
    return added.reshape(streams, dimensions, width // HISTORY).transpose(0, 1)


def through(layers: Sequence[Tensor], value: Tensor) -> Tensor:
    """``[B, I]`` through the layers of a jump, ``[B, D T]``."""
    for layer in layers[:-1]:
        value = torch.addmm(layer[-1], value, layer[:-1]).relu()
    return torch.addmm(layers[-1][-1], value, layers[-1][:-1])


def correct(
    carried: Carried, prediction: Tensor, following: Carried, weights: Tensor, bias: Tensor, anchor: bool
) -> Carried:
    """What is carried to step k + 1 with the correction of step k.

    Args:
        carried: to step k.
        prediction: the network's output at step k, ``[B, T, D]``.
        following: what is carried to step k + 1 without a correction.
        weights: of the correction at step k, ``[G, 6 T, T]``.
        bias: of the correction at step k, ``[D, 1, T]``, or ``[D, B, T]`` with what it reads of the observation.
        anchor: whether step k enters the history.
    """
    added = (features(carried, prediction) @ weights + bias).permute(1, 2, 0)
    history = carried.history
    if anchor:
        history = torch.cat([carried.sample, prediction, history[:, : history.shape[1] // 2]], dim=1)
    return Carried(following.sample + added, following.memory, history)


def hold(carried: Carried, known: Known | None, k: int) -> Carried:
    """What is carried to step k, or from the last, with what is known of the sample in its place; NaN is not known."""
    if known is None:
        return carried
    sample, values = carried.sample.clone(), torch.from_numpy(known.values[k])
    place = (slice(None), known.positions, known.channels)
    sample[place] = torch.where(values.isnan(), sample[place], values)
    return carried._replace(sample=sample)
