"""Devices and types that torch may have, and whether it does."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from copy import copy
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from ttscompile.core.coercion import Array
from ttscompile.core.spec import BF16, FP16, FP32
from ttscompile.errors import RuntimeUnavailableError, first_line

NARROW = {FP32: None, BF16: torch.bfloat16, FP16: torch.float16}
"""Precisions of the products in residual blocks."""

_CUDNN: Any = torch.backends.cudnn
_ONEDNN: Any = torch.backends.mkldnn
_ROUNDING = torch.backends.cuda.matmul, _CUDNN.conv, _CUDNN.rnn, _ONEDNN.matmul, _ONEDNN.conv, _ONEDNN.rnn
"""Operations that torch may be told to compute float32 in fewer bits for."""

_EXACT = ("ieee", "none")

Setting = TypeVar("Setting")
Own = TypeVar("Own", bound="OnTensors")


def device_of(name: str) -> torch.device:
    """The device of this name, with its number where such devices have one, once it was found to work.

    Raises:
        RuntimeUnavailableError: torch knows no such device, or cannot compute there.
    """
    try:
        found: torch.device = torch.zeros(1, device=torch.device(name)).add_(1).device
    except Exception as error:  # AssertionError of a build without CUDA, RuntimeError, AcceleratorError, TypeError
        remedy = "Use device='cpu', or install the build of torch that has it: https://pytorch.org/get-started."
        raise RuntimeUnavailableError(f"device {name!r} cannot be had: {first_line(error)}. {remedy}") from error
    return found


@contextmanager
def exact_arithmetic(device: torch.device | None) -> Iterator[None]:
    """Within the block float32 is computed in float32, whatever the caller told torch: no autocast, no TF32.

    The settings of torch, of which autocast is the thread's and the others are the process's, are as they were after
    it. They have older and newer names; the older ones cannot be read where a caller has used the newer.
    """
    cudnn, kinds = torch.backends.cudnn, {"cpu"} if device is None else {"cpu", device.type}
    matmul, convolution = _older(torch.get_float32_matmul_precision), _older(lambda: bool(cudnn.allow_tf32))
    newer = [(operations, operations.fp32_precision) for operations in _ROUNDING]
    with ExitStack() as settings:
        for kind in filter(torch.amp.is_autocast_available, kinds):
            settings.enter_context(torch.autocast(kind, enabled=False))
        try:
            if matmul not in (None, "highest"):
                torch.set_float32_matmul_precision("highest")
            if convolution:
                cudnn.allow_tf32 = False
            for operations, before in newer:
                if before not in _EXACT:
                    operations.fp32_precision = "ieee"
            yield
        finally:
            if matmul not in (None, "highest"):
                torch.set_float32_matmul_precision(matmul)
            if convolution:
                cudnn.allow_tf32 = True
            for operations, before in newer:
                if before not in _EXACT or matmul != "highest":
                    operations.fp32_precision = before


def _older(read: Callable[[], Setting]) -> Setting | None:
    """A setting by its older name; None where the newer ones say what it cannot."""
    try:
        return read()
    except RuntimeError:
        return None


class OnTensors:
    """What computes with tensors of its own: attributes of the names in ``TENSORS``, None for one it lacks."""

    TENSORS: tuple[str, ...] = ()

    def tensors(self) -> dict[str, Tensor]:
        """What it computes with, by name."""
        return {name: value for name in self.TENSORS if isinstance(value := getattr(self, name), Tensor)}

    def on(self: Own, tensors: Mapping[str, Tensor]) -> Own:
        """The same with other tensors in the place of ``tensors()``."""
        other = copy(self)
        for name in self.TENSORS:
            setattr(other, name, tensors.get(name))
        return other


def placed(array: Array, device: torch.device) -> Tensor:
    """A copy of an array as a tensor of a device."""
    return torch.from_numpy(np.array(array)).to(device)


def narrow_type(precision: str, device: torch.device) -> torch.dtype | None:
    """The type that products are computed in; None for float32. Raises RuntimeUnavailableError: it cannot be had."""
    if precision not in NARROW:
        expected = ", ".join(NARROW)
        raise RuntimeUnavailableError(f"runtime 'torch' has no precision {precision!r}; expected one of {expected}.")
    narrow = NARROW[precision]
    if narrow is not None and not torch.amp.is_autocast_available(device.type):
        raise RuntimeUnavailableError(f"device {device.type!r} has no precision {precision!r}. Use 'fp32'.")
    return narrow
