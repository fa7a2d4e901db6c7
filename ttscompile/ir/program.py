"""The program that the passes rewrite: a denoiser, and step by step the pieces it becomes."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.spec import PolicySpec
from .graph import Graph, TensorType


class Binding(enum.Enum):
    """When a value is known; DESIGN section 3, ``hoist``."""

    CONSTANT = "constant"  # weights and what follows from them: at compile time
    TABLE = "table"  # also from the timestep: at compile time, one row for each step k
    CONDITION = "condition"  # from the observation: once a call
    STEP = "step"  # from observation and timestep: once a call, all K steps in one batch
    LOOP = "loop"  # from the noisy sample: inside the loop


@dataclass(frozen=True)
class Block:
    """One residual block ``x <- x + f(x, context)``.

    Attributes:
        index: position in the order of execution.
        kind: ``self_attention``, ``cross_attention``, ``feed_forward`` or a structural signature.
        stream: value that flows in, ``a_{i-1}``.
        result: value that flows out, ``a_i``.
        residual: value that is added; None for a coarse block, whose residual is ``result - stream``.
        type: of stream, residual and result.
        group: number of its FORWARD group: blocks of one kind and one shape.
        flops: of one evaluation for one stream, after hoisting.
        reason: why it is coarse; empty for a plain residual.
    """

    index: int
    kind: str
    stream: str
    result: str
    residual: str | None
    type: TensorType
    group: int
    flops: int = 0
    reason: str = ""


@dataclass(frozen=True)
class Reuse:
    """The reuse branch of one block: where its residual may be cached and read.

    Attributes:
        type: of the cached residual.
        forward: number of the ``forward[group]`` cache that it writes, and reads when FORWARD.
        forward_blocks: blocks whose residuals that cache can hold.
    """

    type: TensorType
    forward: int
    forward_blocks: tuple[int, ...]


@dataclass(frozen=True)
class Pieces:
    """The denoiser cut up. ``contexts`` of a loop piece are its inputs beside sample or stream.

    Attributes:
        condition: observations -> condition values, once a call. Before ``hoist`` it holds the whole prologue.
        step: condition values and table rows -> step values; run with a batch of K*B, step-major.
        stem: sample -> residual stream.
        blocks: residual stream -> residual.
        tail: residual stream -> prediction.
        pruner: condition values -> logits ``[B, K, blocks, 4]``; None before ``insert_pruner``.
        tables: value of each TABLE context for every step, ``[K, ...]`` with a batch of one in its batch axis.
        bindings: binding of every context of the loop pieces and of ``step``.
        features: condition values that the pruner reads.
    """

    condition: Graph
    step: Graph | None
    stem: Graph
    blocks: tuple[Graph, ...]
    tail: Graph
    pruner: Graph | None = None
    tables: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    bindings: Mapping[str, Binding] = field(default_factory=dict)
    features: tuple[str, ...] = ()


@dataclass(frozen=True)
class Program:
    """What passes take and give.

    Attributes:
        spec: the policy beside its network.
        denoiser: graph of one evaluation: inputs sample, timestep, observations; output the prediction.
        weights: value of every constant of every graph.
        blocks: block table; empty before ``find_residual_blocks`` ran.
        pieces: None before ``partition``.
        reuse: one a block; empty before ``insert_reuse``.
        dense_flops: of one call of the captured denoiser as it was, K evaluations, one stream.
    """

    spec: PolicySpec
    denoiser: Graph
    weights: Mapping[str, npt.NDArray[np.generic]]
    blocks: tuple[Block, ...] = ()
    pieces: Pieces | None = None
    reuse: tuple[Reuse, ...] = ()
    dense_flops: int = 0
