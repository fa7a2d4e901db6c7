"""Linear layers on the CPU whose weights lie as a library's kernels read them.

A block streams its weights from memory once a step. Read as they are stored, rows of one output each, by MKL, they come
at half the speed: with 29 MB of weights in turn and 16 rows, the six products of a decoder layer of width 256 take
820 us so, 500 us packed by oneDNN, and 400 us packed by FBGEMM in half precision. FBGEMM reads half as many bytes and
computes in float32, so it is taken for weights that half precision holds as they are: those of a policy that was saved
so. The operations are those that TorchInductor packs weights with when it freezes a model, and those of torch's
quantized layers.
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

HALF_LINEAR: Callable[..., Any] | None = None
"""``linear`` of x and what ``half_weight`` made."""
if {"x86", "fbgemm"}.intersection(torch.backends.quantized.supported_engines):
    HALF_LINEAR = torch.ops.quantized.linear_dynamic_fp16.default._op

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


def half_weight(weight: Tensor, bias: Tensor | None) -> Any:
    """A weight that half precision holds as it is, with its bias; None for any other, and where FBGEMM is not."""
    usable = HALF_LINEAR is not None and torch.backends.quantized.engine in ("x86", "fbgemm")
    if not usable or not torch.equal(weight.half().float(), weight):
        return None
    return torch.ops.quantized.linear_prepack_fp16(weight, bias)


def gelu_kind(node: Node) -> str:
    """``approximate`` of a node of gelu: "none" or "tanh"."""
    return str(dict(node.kwargs).get("approximate", "none"))
