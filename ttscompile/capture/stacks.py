"""Operations that put tensors beside each other, as the ``cat`` that they are.

``hstack`` and its kind first give each tensor the axes that it lacks. torch's ONNX exporter makes of that a function
over a list of tensors, which no runtime here executes; passes see through ``cat``, and not through these.
Source: the definitions in torch's documentation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

Tensors = Sequence[Tensor]


def _hstack(tensors: Tensors) -> Tensor:
    """Along the first axis of vectors, along the second of all others."""
    wide = [one.reshape(-1) if one.ndim == 0 else one for one in tensors]
    return torch.cat(wide, 0 if wide[0].ndim == 1 else 1)


def _vstack(tensors: Tensors) -> Tensor:
    """Along the first axis, where a vector is a row."""
    return torch.cat([one.reshape(1, -1) if one.ndim < 2 else one for one in tensors], 0)


def _dstack(tensors: Tensors) -> Tensor:
    """Along the third axis, where a vector is a row, and a matrix has one number there."""
    rows = [one.reshape(1, -1) if one.ndim < 2 else one for one in tensors]
    return torch.cat([one.unsqueeze(-1) if one.ndim == 2 else one for one in rows], 2)


def _column_stack(tensors: Tensors) -> Tensor:
    """Along the second axis, where a vector is a column."""
    return torch.cat([one.reshape(-1, 1) if one.ndim < 2 else one for one in tensors], 1)


AS_CAT: Mapping[Any, Callable[[Tensors], Tensor]] = {
    torch.ops.aten.hstack.default: _hstack,
    torch.ops.aten.vstack.default: _vstack,
    torch.ops.aten.dstack.default: _dstack,
    torch.ops.aten.column_stack.default: _column_stack,
}
"""By operation, for ``ExportedProgram.run_decompositions``."""
