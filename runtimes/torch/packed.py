"""Linear layers on the CPU whose weights lie as oneDNN's kernels read them, and what can be done in the same pass.

A block streams its weights from memory once a step. Read as they are stored, rows of one output each, by MKL, they come
at half the speed: with 30 MB of weights in turn and 16 rows, the four products of a decoder layer of width 256 take
520 us packed and 830 us not. The operations are those that TorchInductor packs weights with when it freezes a model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ttscompile.ir.graph import Node

PACKED_LINEAR: Callable[..., Any] | None = None
"""``linear`` of x, a packed weight and a bias, then "none" or "gelu", no scalars, and how gelu is approximated."""
if torch._C._has_mkldnn and hasattr(torch.ops.mkldnn, "_linear_pointwise"):
    PACKED_LINEAR = torch.ops.mkldnn._linear_pointwise.default._op  # without a frame of Python's around it

LINEAR, GELU = "aten.linear.default", "aten.gelu.default"


def packs(value: Any, weight: Any) -> bool:
    """Whether a linear layer on this value, with this constant weight, can be packed."""
    there = PACKED_LINEAR is not None and hasattr(torch.ops.mkldnn, "_reorder_linear_weight")
    fits = all(isinstance(t, Tensor) and t.device.type == "cpu" and t.dtype == torch.float32 for t in (value, weight))
    return there and fits and weight.ndim == 2 and value.ndim > 1 and value.numel() > 0 < weight.numel()


def packed_weight(value: Tensor, weight: Tensor) -> Tensor:
    """A weight as it is read for every value of this shape."""
    result: Tensor = torch.ops.mkldnn._reorder_linear_weight(weight, value.numel() // value.shape[-1])
    return result


def gelu_kind(node: Node) -> str:
    """``approximate`` of a node of gelu: "none" or "tanh"."""
    return str(dict(node.kwargs).get("approximate", "none"))
