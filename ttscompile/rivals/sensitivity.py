"""How actions respond to what each cell of a plan adds: one sparse rollout with its gradient, and all blocks beside it.

``linear`` and ``slopes`` predict from this what another plan would do, without running it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from ..calibration.calls import Calls, IntArray
from ..calibration.execute import Executor, last
from ..core.lattice import PlanArray, Source

BYTES = 2**28
"""Memory for what the blocks compute; gradients and what they need take three to four times as much."""


def chunks(executor: Executor, count: int) -> Iterator[IntArray]:
    """Numbers of ``count`` calls, as many at once as there is memory for."""
    each = 4 * executor.model.steps * sum(math.prod(type_.at(1)) for type_ in executor.types)
    chunk = int(np.clip(BYTES // each, 1, 32))
    return (np.arange(start, min(start + chunk, count)) for start in range(0, count, chunk))


def sensitivity(
    executor: Executor, plan: PlanArray, reuse: Source, calls: Calls, copies: int, figure: Callable[[Tensor], Tensor]
) -> tuple[list[Tensor], list[Tensor]]:
    """Run the plan, and go back from a figure.

    Args:
        plan: ``[K, blocks]`` of COMPUTE and ``reuse``, step 0 dense.
        copies: how many streams there are of each call, one after the other: ``[copies * N]``.
        figure: a number, of the denoised samples ``[copies * N, T, D]``.

    Returns:
        On the CPU, by the number of a cell, ``k * blocks + b``: what its block computes there, or would, for each call
        (``[N, size]``), and the gradient of the figure in what the cell adds, for each stream (``[copies * N, size]``).
    """
    model, count = executor.model, calls.count
    streams = executor.select(calls, np.tile(np.arange(count), copies))
    cache: dict[int, Tensor] = {}
    computed: list[Tensor] = []
    passed: list[Tensor] = []  # the stream after additions: its gradient is that of what was added just before
    position: list[int] = []

    def blocks(k: int, stream: Tensor) -> Tensor:
        row = plan[k]
        computes = bool((row == Source.COMPUTE).any()) or not executor.alike
        for b, axis in enumerate(executor.axes):
            key = model.groups[b] if reuse == Source.FORWARD else b
            if row[b] == Source.COMPUTE:
                cache[key] = model.block(b, k, stream, streams.contexts)
                computed.append(_rows(cache[key].detach(), axis)[:count])
            else:
                with torch.no_grad():
                    first = stream.narrow(axis, 0, count)
                    computed.append(_rows(model.block(b, k, first, calls.contexts), axis))
            stream = stream + cache[key]
            if computes:
                position.append(len(passed))
                passed.append(stream)
        if not computes:  # nothing but additions: one gradient serves all blocks
            position.extend([len(passed)] * len(row))
            passed.append(stream)
        return stream

    streams.initial.requires_grad_()
    gradients = torch.autograd.grad(figure(last(executor.samples(streams, blocks))), passed)
    axes = executor.axes * model.steps
    return computed, [_rows(gradients[i], axis) for i, axis in zip(position, axes, strict=True)]


def _rows(values: Tensor, axis: int) -> Tensor:
    """One row a stream, on the CPU."""
    return values.movedim(axis, 0).flatten(1).cpu()
