"""A network as a frontend gives it: a denoiser, maybe behind an observation encoder, and copies of it.

The compiler changes no module that it was given, and holds no weight more often than it has to.
"""

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import nn

from ..errors import CaptureError


class EncodedDenoiser(nn.Module):
    """A denoiser whose observations go through an encoder that the original evaluates once a call, not once a step.

    Captured as one module; the encoder depends on the observation alone, so hoisting takes it out of the loop. What
    runs or measures the original asks ``parts`` for it, and evaluates or counts it once.
    """

    def __init__(self, encoder: nn.Module, denoiser: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.denoiser = denoiser

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, **observations: torch.Tensor) -> torch.Tensor:
        """``[B, T, D]``, ``[B]`` and the observations by key -> ``[B, T, D]``."""
        return self.denoiser(sample, timestep, self.encoder(observations))  # type: ignore[no-any-return]


class Parts(NamedTuple):
    """What the original evaluates: the encoder, if there is one, once a call; the denoiser at every step."""

    encoder: nn.Module | None
    denoiser: nn.Module


def parts(module: nn.Module) -> Parts:
    """The parts of a network as a frontend or a user gives it: the one place that asks of which class it is."""
    return Parts(module.encoder, module.denoiser) if isinstance(module, EncodedDenoiser) else Parts(None, module)


def sharing_copy(module: nn.Module) -> nn.Module:
    """A copy on the CPU, in float32 and eval mode, for reading: parameters that are so already are the same memory.

    Modules and buffers are its own. A copy of all weights for each stage would take several times their memory.
    """
    # Of other classes, as those that have no shape yet, a plain copy is made.
    plain = (each for each in module.parameters() if type(each) is nn.Parameter)
    shared = {id(each): nn.Parameter(each.detach(), each.requires_grad) for each in plain}
    return own_copy(module, shared).cpu().float().eval()


def own_copy(module: nn.Module, shared: Mapping[int, nn.Parameter] = MappingProxyType({})) -> nn.Module:
    """A copy that shares nothing with a module whose owner may go on to train it, but what ``shared`` has by id."""
    if not isinstance(module, nn.Module):
        remedy = "Write a class of it, with the network as an attribute and the call in its forward."
        raise CaptureError(f"expected an nn.Module; found {type(module).__name__}. {remedy}")
    if isinstance(module, nn.DataParallel | nn.parallel.DistributedDataParallel):
        raise CaptureError(f"expected the network itself; found {type(module).__name__} around it. Pass module.module.")
    if any(isinstance(each, torch.jit.ScriptModule) for each in module.modules()):
        raise CaptureError(f"{type(module).__name__} holds TorchScript. Pass the module that was scripted or traced.")
    try:
        return copy.deepcopy(module, dict[int, object](shared))
    except Exception as error:  # whatever its attributes raise
        raise CaptureError(
            f"{type(module).__name__} cannot be copied: {error} Of a weight that is computed from others, call"
            " torch.nn.utils.remove_weight_norm or parametrize.remove_parametrizations first; take locks and files out."
        ) from error
