"""Steps without a computed block, where the network allows it (``ir.idle_form`` says what is computed)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ttscompile.ir.idle_form import IdleForm

from . import devices


class Prepared(NamedTuple):
    """What the total of idle steps decides.

    Attributes:
        rows: of y, ``[D + 1, B T]``.
        numerator: ``[D, B T]``.
        shift: ``[D, B T]``, what is added to the quotient.
    """

    rows: Tensor
    numerator: Tensor
    shift: Tensor


class IdleSteps(devices.OnTensors):
    """What steps that add one sum of residuals predict, from numbers of the size of the sample."""

    TENSORS = ("constant", "head", "shift", "along", "across", "basis")

    def __init__(self, form: IdleForm, device: torch.device) -> None:
        def there(array: object) -> Tensor:
            return devices.placed(np.asarray(array, np.float32), device)

        self._turned, self._norm = form.turned, form.norm
        self.constant, self.head, self.shift = there(form.constant), there(form.head), there(form.shift)
        self._dimensions = form.head.shape[1]
        product = there(form.product)
        self.along, self.across = product[: self._dimensions + 1], product[self._dimensions + 1 :]
        self._held = not form.product.any()  # the prediction is the total's, whatever the sample is
        self.basis = None if form.norm is None else there(form.norm.basis)
        self.fused: Any = None  # the module of that name, where there are a GPU and Triton

    def prepare(self, total: Tensor) -> Prepared:
        """What is known as soon as the total is."""
        stream = (total.transpose(0, 1) if self._turned else total) + self.constant
        if self._norm is None or self.basis is None:
            numerator = stream @ self.head
            blank = torch.zeros_like(numerator)
            rows = torch.cat([blank, torch.ones_like(blank[..., :1])], 2)
        else:
            width = stream.shape[2]
            centred = stream - stream.mean(2, keepdim=True)
            along = centred @ self.basis
            across = centred - along @ self.basis.T
            deviation = ((across * across).sum(2, keepdim=True) / width + self._norm.eps).sqrt()
            rows, numerator = torch.cat([along / width**0.5, deviation], 2), centred @ self.head
        shift = self.shift.expand(-1, len(stream), -1)
        return Prepared(rows.permute(2, 0, 1).flatten(1), numerator.permute(2, 0, 1).flatten(1), shift.flatten(1))

    def predict(self, known: Prepared, sample: Tensor) -> Tensor:
        """The prediction ``[D, B, T]`` for the sample ``[D, B, T]``, contiguous."""
        rows, numerator, shift = known
        if not self._held:
            flat = sample.view(self._dimensions, -1)
            rows = torch.addmm(rows, self.along, flat)
            numerator = torch.addmm(numerator, self.across, flat)
        return torch.addcdiv(shift, numerator, torch.linalg.vector_norm(rows, dim=0)).view(sample.shape)
