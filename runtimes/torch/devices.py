"""Devices and types that torch may have, and whether it does."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ttscompile.core.spec import BF16, FP16, FP32
from ttscompile.errors import RuntimeUnavailableError

NARROW = {FP32: None, BF16: torch.bfloat16, FP16: torch.float16}
"""Precisions of the products in residual blocks."""


def device_of(name: str) -> torch.device:
    """The device of this name, once it was found to work.

    Raises:
        RuntimeUnavailableError: torch knows no such device, or cannot compute there.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).add_(1)
    except Exception as error:  # AssertionError of a build without CUDA, RuntimeError, AcceleratorError, TypeError
        first = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        problem = f"device {name!r} cannot be had: {first}"
        remedy = "Use device='cpu', or install the build of torch that has it: https://pytorch.org/get-started."
        raise RuntimeUnavailableError(f"{problem}. {remedy}") from error
    return device


def placed(array: npt.NDArray[np.generic], device: torch.device) -> Tensor:
    """A copy of an array as a tensor of a device."""
    return torch.tensor(array).to(device)


def narrow_type(precision: str, device: torch.device) -> torch.dtype | None:
    """The type that products are computed in; None for float32.

    Raises:
        RuntimeUnavailableError: not a precision of this runtime, or none of the device.
    """
    if precision not in NARROW:
        expected = ", ".join(NARROW)
        raise RuntimeUnavailableError(f"runtime 'torch' has no precision {precision!r}; expected one of {expected}.")
    narrow = NARROW[precision]
    if narrow is not None and not torch.amp.is_autocast_available(device.type):
        raise RuntimeUnavailableError(f"device {device.type!r} has no precision {precision!r}. Use 'fp32'.")
    return narrow
