"""The U-Net of Diffusion Policy, 3D Diffusion Policy and LeRobot's ``diffusion``, rebuilt from its configuration.

Written from the description of the network, with attribute names under which the weights of an original checkpoint
load as they are.

Source: Chi et al., Diffusion Policy (arXiv 2303.04137), the convolutional network, after Janner et al. (arXiv
2205.09991); FiLM of Perez et al. (arXiv 1709.07871).
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import torch
from torch import nn

from ttscompile.errors import CheckpointError

from .transformer_for_diffusion import SinusoidalEmbedding

_GROUPS_AT_THE_END = 8
"""Of the last convolution, whatever ``n_groups`` says, as in the original."""
_OPTIONAL = ("local_cond_dim", "global_cond_dim")
_SIZES = ("input_dim", *_OPTIONAL, "diffusion_step_embed_dim", "kernel_size", "n_groups")


def _refusal(name: str, found: object, expected: str) -> CheckpointError:
    return CheckpointError(f"{name} of the U-Net is {found!r:.200}; expected {expected}.")


@dataclass(frozen=True)
class UNetConfig:
    """Sizes and variant of one network; the names are those of the original configuration.

    Attributes:
        local_cond_dim: channels of a condition for each step of the sample; None for none.
        global_cond_dim: channels of the condition vector; None for none.
        down_dims: channels of the levels; every level but the last halves the number of steps.
        n_groups: of their group norms.
        cond_predict_scale: whether the condition scales the features as well as shifting them.
        condition_layer: whether a layer of the condition's own width comes before scale and shift.
        blocks: of a level and in the middle, 2 or 1.
        conditioned: whether the levels down, the middle, and those up are given the condition; the weights for it are
            there in any case.
    """

    input_dim: int
    local_cond_dim: int | None = None
    global_cond_dim: int | None = None
    diffusion_step_embed_dim: int = 256
    down_dims: tuple[int, ...] = (256, 512, 1024)
    kernel_size: int = 3
    n_groups: int = 8
    cond_predict_scale: bool = False
    condition_layer: bool = False
    blocks: Literal[1, 2] = 2
    conditioned: tuple[bool, bool, bool] = (True, True, True)

    def __post_init__(self) -> None:
        if type(self.cond_predict_scale) is not bool:
            raise _refusal("cond_predict_scale", self.cond_predict_scale, "true or false")
        dims = self.down_dims
        if not isinstance(dims, (list, tuple)) or not dims or any(type(n) is not int or n < 1 for n in dims):
            raise _refusal("down_dims", dims, "positive whole numbers")
        object.__setattr__(self, "down_dims", tuple(dims))
        for name in _SIZES:
            value = getattr(self, name)
            if (value is not None or name not in _OPTIONAL) and (type(value) is not int or value < 1):
                raise _refusal(name, value, "a whole number from 1")
        if self.diffusion_step_embed_dim < 4 or self.diffusion_step_embed_dim % 2:
            raise _refusal("diffusion_step_embed_dim", self.diffusion_step_embed_dim, "an even width from 4 on")
        if self.kernel_size % 2 == 0:
            raise _refusal("kernel_size", self.kernel_size, "an odd number")
        if any(n % self.n_groups for n in dims) or dims[0] % _GROUPS_AT_THE_END:
            found = f"down_dims = {list(dims)} with n_groups = {self.n_groups}"
            raise CheckpointError(
                f"the U-Net has {found}; expected channels that the groups divide, the first also by"
                f" {_GROUPS_AT_THE_END}."
            )

    @property
    def divisor(self) -> int:
        """What the number of steps of the sample has to be divisible by, so that halving and doubling give it again."""
        return int(2 ** (len(self.down_dims) - 1))

    @property
    def condition_dim(self) -> int:
        """Channels of the timestep's embedding and the condition vector together."""
        return self.diffusion_step_embed_dim + (self.global_cond_dim or 0)


class ConvolutionBlock(nn.Module):
    """Convolution, group norm, Mish; a module within a module, as the checkpoints name their weights."""

    def __init__(self, channels_in: int, channels: int, kernel_size: int, groups: int) -> None:
        super().__init__()
        convolution = nn.Conv1d(channels_in, channels, kernel_size, padding=kernel_size // 2)
        self.block = nn.Sequential(convolution, nn.GroupNorm(groups, channels), nn.Mish())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, channels_in, T]`` -> ``[B, channels, T]``."""
        return self.block(x)  # type: ignore[no-any-return]


class ConditionedBlock(nn.Module):
    """Two convolutions with FiLM between them, and a shortcut around both."""

    def __init__(self, channels_in: int, channels: int, config: UNetConfig) -> None:
        super().__init__()
        self.scales = config.cond_predict_scale
        sizes = ((channels_in, channels), (channels, channels))
        self.blocks = nn.ModuleList(ConvolutionBlock(*each, config.kernel_size, config.n_groups) for each in sizes)
        width = config.condition_dim
        before = (nn.Mish(), nn.Linear(width, width)) if config.condition_layer else ()
        self.cond_encoder = nn.Sequential(*before, nn.Mish(), nn.Linear(width, channels * (1 + self.scales)))
        self.residual_conv = nn.Conv1d(channels_in, channels, 1) if channels_in != channels else nn.Identity()

    def forward(self, x: torch.Tensor, condition: torch.Tensor | None) -> torch.Tensor:
        """``[B, channels_in, T]``, and ``[B, C]`` or None for no FiLM -> ``[B, channels, T]``."""
        inner = self.blocks[0](x)
        if condition is not None:
            film = self.cond_encoder(condition).unsqueeze(-1)
            if self.scales:
                scale, shift = film.chunk(2, dim=1)
                inner = inner * scale + shift
            else:
                inner = inner + film
        return self.blocks[1](inner) + self.residual_conv(x)  # type: ignore[no-any-return]


def _level(channels_in: int, channels: int, config: UNetConfig) -> list[nn.Module]:
    """The blocks of one level, the first of which changes the number of channels."""
    return [ConditionedBlock(channels if i else channels_in, channels, config) for i in range(config.blocks)]


class Resize(nn.Module):
    """A strided convolution, in a module of its own as the checkpoints name its weights."""

    def __init__(self, convolution: nn.Module) -> None:
        super().__init__()
        self.conv = convolution

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, C, T]`` -> ``[B, C, T / 2]`` or ``[B, C, 2 T]``."""
        return self.conv(x)  # type: ignore[no-any-return]


class ConditionalUnet1D(nn.Module):
    """The denoiser: noisy sample, timestep and conditions to a prediction, by convolutions along the chunk's time."""

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        width, dims = config.diffusion_step_embed_dim, config.down_dims
        self.diffusion_step_encoder = nn.Sequential(
            SinusoidalEmbedding(width), nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width)
        )
        self.local_cond_encoder = None
        if config.local_cond_dim is not None:
            # The second one is in every checkpoint, and the original never uses what it gives.
            each = (ConditionedBlock(config.local_cond_dim, dims[0], config) for _ in range(2))
            self.local_cond_encoder = nn.ModuleList(each)
        self.down_modules = nn.ModuleList()
        for level, (before, after) in enumerate(pairwise((config.input_dim, *dims))):
            halve = Resize(nn.Conv1d(after, after, 3, 2, 1)) if level < len(dims) - 1 else nn.Identity()
            self.down_modules.append(nn.ModuleList((*_level(before, after, config), halve)))
        self.mid_modules = nn.ModuleList(_level(dims[-1], dims[-1], config))
        self.up_modules = nn.ModuleList()
        for after, before in pairwise(reversed(dims)):
            double = Resize(nn.ConvTranspose1d(before, before, 4, 2, 1))
            self.up_modules.append(nn.ModuleList((*_level(2 * after, before, config), double)))
        last = ConvolutionBlock(dims[0], dims[0], config.kernel_size, _GROUPS_AT_THE_END)
        self.final_conv = nn.Sequential(last, nn.Conv1d(dims[0], config.input_dim, 1))

    def forward(
        self,
        sample: torch.Tensor,
        timestep: torch.Tensor,
        global_cond: torch.Tensor | None = None,
        local_cond: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Evaluate the denoiser once.

        Args:
            sample: float32 ``[B, T, input_dim]``, T divisible by ``config.divisor``.
            timestep: int64 ``[B]``.
            global_cond: float32 ``[B, global_cond_dim]``; None without one.
            local_cond: float32 ``[B, T, local_cond_dim]``; None without one.

        Returns:
            float32 ``[B, T, input_dim]``.
        """
        condition = self.diffusion_step_encoder(timestep)
        if global_cond is not None:
            condition = torch.cat((condition, global_cond), dim=-1)
        on_down, on_middle, on_up = (condition if each else None for each in self.config.conditioned)
        x = sample.transpose(1, 2)
        skipped = []
        down: Any = self.down_modules  # lists of modules, as torch does not say
        up: Any = self.up_modules
        for level, (first, *others, resize) in enumerate(down):
            x = first(x, on_down)
            if level == 0 and local_cond is not None and self.local_cond_encoder is not None:
                x = x + self.local_cond_encoder[0](local_cond.transpose(1, 2), condition)
            for block in others:
                x = block(x, on_down)
            skipped.append(x)
            x = resize(x)
        for block in self.mid_modules:
            x = block(x, on_middle)
        for *blocks, resize in up:
            x = torch.cat((x, skipped.pop()), dim=1)
            for block in blocks:
                x = block(x, on_up)
            x = resize(x)
        return self.final_conv(x).transpose(1, 2)  # type: ignore[no-any-return]
