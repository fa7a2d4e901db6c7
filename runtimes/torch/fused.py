"""Steps without a computed block as one kernel of a GPU, where there is Triton.

Each such step is a few products of the size of the sample (``idle_steps``, ``sampler``): twelve kernels, that each take
two microseconds to begin and next to nothing to compute. Here one kernel goes through all steps of a run, a program for
each stream, and keeps what they hand on in memory that only it touches. What the history adds to each step does not
change within a run, and is added to the offsets before it.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from ttscompile.core.correction import HISTORY

from .sampler import Advance, IdleSteps, Prepared, State

LARGEST = 2**18
"""Numbers of a step's matrices: a larger step is no faster on the one multiprocessor that a stream has."""

TILE = 2**12
"""Numbers of a matrix that are multiplied at a time."""


def works(device: torch.device) -> bool:
    """Whether Triton compiles here, which takes a C compiler; a warning says why not."""
    try:
        _one[(1,)](torch.zeros(1, device=device))
    except Exception as error:  # RuntimeError without a compiler, CalledProcessError without Python.h
        told = f"Triton cannot compile: {type(error).__name__}: {str(error)[:200]}"
        warnings.warn(f"{told}. Steps without a computed block take a dozen kernels each. Install gcc.", stacklevel=2)
        return False
    return True


def fits(advance: Advance, k: int, count: int) -> bool:
    """Whether ``count`` steps from k on can run here, which anchors cannot, and are faster so."""
    numbers = advance.dimensions * advance.updates[0, 0].numel()
    return count > 1 and not any(advance.anchors[k : k + count]) and numbers <= LARGEST


def run(idle: IdleSteps, known: Prepared, advance: Advance, state: State, k: int, offset: Sequence[Tensor]) -> State:
    """Steps k, k + 1, ..., one for each of ``offset``, none of which is an anchor; see ``Advance``."""
    dimensions, streams, horizon = state.sample.shape
    memories, count = advance.memories, len(offset)
    matrices = advance.updates[k : k + count]
    of_history = torch.matmul(state.history, matrices[:, :, 2 * horizon : (2 + HISTORY) * horizon])
    offsets = torch.stack(list(offset)) + of_history
    places = 2 + (advance.clip is not None) + memories
    features = state.sample.new_empty(2, dimensions, streams, places * horizon)
    rows, columns = triton.next_power_of_2(dimensions), triton.next_power_of_2(horizon)
    _steps[(streams,)](
        features, state.sample, state.memory.contiguous(), offsets, *map(Tensor.contiguous, known),
        idle.along, idle.across, matrices, advance.to_clean, k, count, streams, advance.clip or 0.0,
        matrices.stride(0), matrices.stride(1) * (len(matrices[0]) > 1),
        dimensions, horizon, memories, advance.clip is not None, HISTORY, rows, columns,
        triton.next_power_of_2(dimensions + 1), max(TILE // (rows * columns), 1),
    )  # fmt: skip
    made = features[count % 2]
    return State(made[..., :horizon].contiguous(), state.history, made[..., (places - memories) * horizon :])


@triton.jit
def _one(number):
    tl.store(number, 1.0)


@triton.jit
def _steps(  # noqa: PLR0913  # a kernel has no records
    features, sample, memory, offset, rows, numerator, shift, along, across, matrices, to_clean,
    first, count, streams, bound, step_stride, group_stride,
    D: tl.constexpr, T: tl.constexpr, S: tl.constexpr, CLIPS: tl.constexpr, HISTORIES: tl.constexpr,
    DP: tl.constexpr, TP: tl.constexpr, NP: tl.constexpr, RP: tl.constexpr,
):  # fmt: skip
    """A stream's steps; ``D`` action dimensions, ``T`` positions, ``S`` memories; ``DP``, ... hold them as tiles."""
    stream = tl.program_id(0)
    d, t, n = tl.arange(0, DP)[:, None], tl.arange(0, TP)[None, :], tl.arange(0, NP)[:, None]
    inside, normed = (d < D) & (t < T), (n < D + 1) & (t < T)
    width: tl.constexpr = (2 + CLIPS + S) * T
    columns: tl.constexpr = (1 + S) * T
    size, own = D * streams * width, (d * streams + stream) * width
    tl.store(features + own + t, tl.load(sample + (d * streams + stream) * T + t, inside), inside)
    for s in tl.static_range(S):
        kept = tl.load(memory + ((d * streams + stream) * S + s) * T + t, inside)
        tl.store(features + own + (2 + CLIPS + s) * T + t, kept, inside)
    column = stream * T + t
    norms = tl.load(rows + n * streams * T + column, normed, other=0.0)
    heads = tl.load(numerator + d * streams * T + column, inside, other=0.0)
    shifts = tl.load(shift + d * streams * T + column, inside, other=0.0)
    for i in range(count):
        now, then = features + (i % 2) * size, features + ((i + 1) % 2) * size
        tl.debug_barrier()
        lengths, head = norms, heads
        for j in range(D):
            x = tl.load(now + (j * streams + stream) * width + t, t < T, other=0.0)
            lengths = lengths + tl.load(along + n * D + j, n < D + 1, other=0.0) * x
            head = head + tl.load(across + d * D + j, d < D, other=0.0) * x
        prediction = shifts + head / tl.where(t < T, tl.sqrt(tl.sum(lengths * lengths, 0)[None, :]), 1.0)
        tl.store(now + own + T + t, prediction, inside)
        if CLIPS:
            weights = to_clean + 2 * (first + i)
            clean = tl.load(now + own + t, inside) * tl.load(weights) + prediction * tl.load(weights + 1)
            clean = tl.clamp(clean, -bound, bound, propagate_nan=tl.PropagateNan.ALL)
            tl.store(now + own + 2 * T + t, clean, inside)
        tl.debug_barrier()
        for c in tl.static_range(1 + S):
            total = tl.load(offset + ((i * D + d) * streams + stream) * columns + c * T + t, inside, other=0.0)
            for start in range(0, width, RP):
                r = start + tl.arange(0, RP)[None, :]
                row = tl.where(r < 2 * T, r, r + HISTORIES * T)
                feature = tl.load(now + own + r, (d < D) & (r < width), other=0.0)
                place = matrices + i * step_stride + d * group_stride + row * columns + c * T
                valid = inside[:, None, :] & (r < width)[:, :, None]
                matrix = tl.load(place[:, :, None] + t[:, None, :], valid, other=0.0)
                total = total + tl.sum(feature[:, :, None] * matrix, 1)
            tl.store(then + own + (c > 0) * (1 + CLIPS + c) * T + t, total, inside)
