"""Names and interfaces of the pieces that a compiled denoiser is cut into.

A piece is a graph that runs as a whole. Its name is the key of its graph in a program, of its ONNX model, of its record
in the manifest and of its session.
"""

from __future__ import annotations

CONDITION = "condition"
"""Observations -> condition values, once a call."""

STEP = "step"
"""Condition values and table rows -> step values, for all K steps in one batch."""

STEM = "stem"
"""Sample -> residual stream."""

TAIL = "tail"
"""Residual stream -> prediction."""

ADVANCE = "advance"
"""Tail, sampler update and the next step's stem in one."""

PRUNER = "pruner"
"""Condition values -> logits of the plan."""


def block_name(index: int) -> str:
    """``block_07``: the piece of one residual block."""
    return f"block_{index:02d}"
