"""Copies of a module: the compiler changes none that it was given, and holds no weight more often than it has to."""

from __future__ import annotations

import copy

from torch import nn

from ..errors import CaptureError


def sharing_copy(module: nn.Module) -> nn.Module:
    """A copy on the CPU, in float32 and eval mode, for reading: parameters that are so already are the same memory.

    Modules and buffers are its own. A copy of all weights for each stage would take several times their memory.
    """
    # Of other classes, as those that have no shape yet, a plain copy is made.
    plain = (each for each in module.parameters() if type(each) is nn.Parameter)
    shared = {id(each): nn.Parameter(each.detach(), each.requires_grad) for each in plain}
    return _copied(module, shared).cpu().float().eval()


def own_copy(module: nn.Module) -> nn.Module:
    """A copy that shares nothing with a module whose owner may go on to train it."""
    return _copied(module, {})


def _copied(module: nn.Module, known: dict[int, nn.Parameter]) -> nn.Module:
    """``known`` says what takes the place of the objects of these ids."""
    try:
        return copy.deepcopy(module, dict[int, object](known))
    except RuntimeError as error:
        raise CaptureError(
            f"{type(module).__name__} cannot be copied: {error} Of a weight that is computed from others, call"
            " torch.nn.utils.remove_weight_norm or parametrize.remove_parametrizations first."
        ) from error
