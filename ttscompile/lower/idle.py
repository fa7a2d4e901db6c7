"""The ONNX model of what steps without a computed block need of the sum that they add (``ir.idle_form``)."""

from __future__ import annotations

import numpy as np
from onnx import ModelProto, helper

from ..ir.idle_form import IdleForm, Norm, Weights, idle_form
from ..ir.pieces import BASE, IDLE, PRODUCT, SHIFT, TOTAL
from ..ir.program import Pieces
from .graph_writer import GraphWriter, tensor
from .onnx_model import own_model


def lower_idle(pieces: Pieces, weights: Weights, opset: int) -> tuple[ModelProto | None, str]:
    """The model of a program with these pieces and values of constants, or None and why there is none."""
    form, why = idle_form(pieces, weights)
    return (None if form is None else _write(form, opset)), why


def _write(form: IdleForm, opset: int) -> ModelProto:
    tokens, dimensions = form.constant.shape[0], form.head.shape[1]
    w = GraphWriter()
    total = w.op("Transpose", TOTAL, perm=[1, 0, 2]) if form.turned else TOTAL
    offset = w.op("Add", total, w.constant(form.constant[None], np.float32))
    if form.norm is None:
        numerator = w.op("MatMul", offset, w.constant(form.head, np.float32))
        blank = w.op("Mul", w.op("Slice", offset, *map(w.constant, ([0], [1], [2]))), w.constant(0.0, np.float32))
        one = w.op("Add", blank, w.constant(1.0, np.float32))
        rows = w.op("Concat", *dimensions * [blank], one, numerator, axis=2)
    else:
        rows = _normed(w, form, form.norm, offset)
    w.rename(w.op("Transpose", rows, perm=[2, 0, 1]), BASE)
    w.rename(w.constant(form.product, np.float32), PRODUCT)
    w.rename(w.constant(form.shift, np.float32), SHIFT)
    shapes = {BASE: [len(form.product), "B", tokens], PRODUCT: form.product.shape, SHIFT: [dimensions, 1, tokens]}
    outputs = [tensor(name, np.float32, shape) for name, shape in shapes.items()]
    given = tensor(TOTAL, np.float32, [n if isinstance(n, int) else str(n) for n in form.type.shape])
    return own_model(w.graph(IDLE, outputs, [given]), [helper.make_opsetid("", opset)])


def _normed(w: GraphWriter, form: IdleForm, norm: Norm, offset: str) -> str:
    """``[B, T, 2 D + 1]`` of a stream ``[B, T, W]``."""
    width = len(form.head)
    last = w.constant([-1])
    u = w.op("Sub", offset, w.op("ReduceMean", offset, last))
    projected = w.op("MatMul", u, w.constant(norm.basis, np.float32))
    across = w.op("Sub", u, w.op("MatMul", projected, w.constant(norm.basis.T, np.float32)))
    variance = w.op("Div", w.op("ReduceSumSquare", across, last), w.constant(width, np.float32))
    deviation = w.op("Sqrt", w.op("Add", variance, w.constant(norm.eps, np.float32)))
    along = w.op("Div", projected, w.constant(np.sqrt(width), np.float32))
    numerator = w.op("MatMul", u, w.constant(form.head, np.float32))
    return w.op("Concat", along, deviation, numerator, axis=2)
