"""The networks of DPPO, an MLP and a U-Net, with attribute names under which the weights of its checkpoints load.

Source: ``DiffusionMLP`` and ``Unet1D`` of irom-princeton/dppo at cc7234a (Ren et al., arXiv 2409.00588), after Chi et
al., Diffusion Policy (arXiv 2303.04137).
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import nn

from .conditional_unet1d import Resize
from .transformer_for_diffusion import SinusoidalEmbedding

ACTIVATIONS: Mapping[str, Callable[[], nn.Module]] = {
    "Mish": nn.Mish,
    "ReLU": nn.ReLU,
    "ELU": nn.ELU,
    "GELU": nn.GELU,
    "Tanh": nn.Tanh,
    "Softplus": nn.Softplus,
    "Identity": nn.Identity,
}


def _time(width: int, hidden: int) -> nn.Sequential:
    """Timesteps ``[B]`` -> ``[B, width]``."""
    return nn.Sequential(SinusoidalEmbedding(width), nn.Linear(width, hidden), nn.Mish(), nn.Linear(hidden, width))


class MLP(nn.Module):
    """Linear layers with an activation between them, and another one after the last.

    Args:
        widths: of the input, of every hidden layer, and of the output.
        norms: whether a layer norm stands before every activation but the last.
    """

    def __init__(self, widths: Sequence[int], activation: str, last: str = "Identity", norms: bool = False) -> None:
        super().__init__()
        self.moduleList = nn.ModuleList()
        for number, (before, after) in enumerate(pairwise(widths), start=2):
            ends = number == len(widths)
            layers: OrderedDict[str, nn.Module] = OrderedDict(linear_1=nn.Linear(before, after))
            if norms and not ends:
                layers["norm_1"] = nn.LayerNorm(after)
            layers["act_1"] = ACTIVATIONS[last if ends else activation]()
            self.moduleList.append(nn.Sequential(layers))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, first width]`` -> ``[B, last width]``."""
        for layer in self.moduleList:
            x = layer(x)
        return x


class _Residual(nn.Module):
    def __init__(self, width: int, activation: str, norms: bool) -> None:
        super().__init__()
        self.l1, self.l2 = nn.Linear(width, width), nn.Linear(width, width)
        self.act = ACTIVATIONS[activation]()
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=1e-6) if norms else nn.Identity() for _ in range(2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        inner = self.l1(self.act(self.norm1(x)))
        return x + self.l2(self.act(self.norm2(inner)))  # type: ignore[no-any-return]


class ResidualMLP(nn.Module):
    """A linear layer, residual blocks of two, and a linear layer; all hidden layers have the first one's width.

    Args:
        widths: as of ``MLP``, of which two hidden ones after the first are a block.
    """

    def __init__(self, widths: Sequence[int], activation: str, last: str = "Identity", norms: bool = False) -> None:
        super().__init__()
        first, hidden, *others, out = widths
        blocks = (_Residual(hidden, activation, norms) for _ in range(len(others) // 2))
        layers = (nn.Linear(first, hidden), *blocks, nn.Linear(hidden, out), ACTIVATIONS[last]())
        self.layers = nn.Sequential(*layers)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, first width]`` -> ``[B, last width]``."""
        return self.layers(x)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class MLPConfig:
    """Sizes of a ``DiffusionMLP``; see ``MLP`` and ``ResidualMLP``, one of which it is.

    Attributes:
        sample: ``(T, Da)``.
        observed: numbers of all observed steps together.
        encoded: widths of an MLP that reads them first; none for none.
    """

    sample: tuple[int, int]
    observed: int
    time: int
    hidden: tuple[int, ...]
    encoded: tuple[int, ...]
    activation: str
    last: str
    norms: bool
    residual: bool


class DiffusionMLP(nn.Module):
    """The whole sample, the timestep and the observed steps as one vector, through an MLP."""

    def __init__(self, config: MLPConfig) -> None:
        super().__init__()
        given, numbers = config.observed, config.sample[0] * config.sample[1]
        self.time_embedding = _time(config.time, 2 * config.time)
        self.cond_mlp: nn.Module = nn.Identity()
        if config.encoded:
            self.cond_mlp, given = MLP((given, *config.encoded), config.activation), config.encoded[-1]
        made = ResidualMLP if config.residual else MLP
        widths = (config.time + numbers + given, *config.hidden, numbers)
        self.mlp_mean = made(widths, config.activation, config.last, config.norms)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, observed: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, ``[B, observed]`` -> ``[B, T, Da]``."""
        given = (sample.flatten(1), self.time_embedding(timestep), self.cond_mlp(observed))
        return self.mlp_mean(torch.cat(given, dim=1)).reshape(sample.shape)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class UnetConfig:
    """Sizes of a ``Unet1D``.

    Attributes:
        actions: Da.
        observed: as of ``MLPConfig``, and so ``encoded``.
        channels: of the levels, each of which but the last halves the number of steps.
        groups: of the norms; None for no norms.
        deep: whether three layers, and not one, read the condition in every block.
        scales: whether the condition scales, too.
    """

    actions: int
    observed: int
    time: int
    encoded: tuple[int, ...]
    channels: tuple[int, ...]
    kernel: int
    groups: int | None
    epsilon: float
    activation: str
    deep: bool
    scales: bool

    @property
    def given(self) -> int:
        """Numbers of the condition: of the time, and of what is made of the observed steps."""
        return self.time + (self.encoded[-1] if self.encoded else self.observed)


class _Convolution(nn.Module):
    def __init__(self, before: int, after: int, config: UnetConfig) -> None:
        super().__init__()
        norm = nn.Identity() if config.groups is None else nn.GroupNorm(config.groups, after, config.epsilon)
        convolution = nn.Conv1d(before, after, config.kernel, padding=config.kernel // 2)
        # The original turns the tensor before and after the norm, which its weights are numbered by.
        self.block = nn.Sequential(convolution, nn.Identity(), norm, nn.Identity(), ACTIVATIONS[config.activation]())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.block(x)  # type: ignore[no-any-return]


class _Conditioned(nn.Module):
    def __init__(self, before: int, after: int, config: UnetConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_Convolution(each, after, config) for each in (before, after))
        width, act = after * (1 + config.scales), ACTIVATIONS[config.activation]
        linear = nn.Linear(config.given, width)
        deeper = (act(), nn.Linear(width, width), act(), nn.Linear(width, width))
        self.cond_encoder = nn.Sequential(linear, *deeper) if config.deep else nn.Sequential(act(), linear)
        self.residual_conv = nn.Conv1d(before, after, 1) if before != after else nn.Identity()
        self.scales = config.scales

    def forward(self, x: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """``[B, before, T]``, ``[B, given]`` -> ``[B, after, T]``."""
        inner, film = self.blocks[0](x), self.cond_encoder(condition).unsqueeze(-1)
        if self.scales:
            scale, film = film.chunk(2, dim=1)
            inner = inner * scale
        return self.blocks[1](inner + film) + self.residual_conv(x)  # type: ignore[no-any-return]


class Unet1D(nn.Module):
    """Convolutions along the chunk's time, each pair of which reads timestep and observation."""

    def __init__(self, config: UnetConfig) -> None:
        super().__init__()
        self.time_mlp = _time(config.time, 4 * config.time)
        self.cond_mlp: nn.Module = nn.Identity()
        if config.encoded:
            self.cond_mlp = ResidualMLP((config.observed, *config.encoded), config.activation)
        levels = config.channels
        self.mid_modules = nn.ModuleList(_Conditioned(levels[-1], levels[-1], config) for _ in range(2))
        self.down_modules, self.up_modules = nn.ModuleList(), nn.ModuleList()
        for number, (before, after) in enumerate(pairwise((config.actions, *levels)), start=1):
            halve = Resize(nn.Conv1d(after, after, 3, 2, 1)) if number < len(levels) else nn.Identity()
            pair = _Conditioned(before, after, config), _Conditioned(after, after, config)
            self.down_modules.append(nn.ModuleList((*pair, halve)))
        for before, after in pairwise(reversed(levels)):
            double = Resize(nn.ConvTranspose1d(after, after, 4, 2, 1))
            pair = _Conditioned(2 * before, after, config), _Conditioned(after, after, config)
            self.up_modules.append(nn.ModuleList((*pair, double)))
        last = _Convolution(levels[0], levels[0], config)
        self.final_conv = nn.Sequential(last, nn.Conv1d(levels[0], config.actions, 1))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, observed: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, ``[B, observed]`` -> ``[B, T, Da]``."""
        condition = torch.cat((self.time_mlp(timestep), self.cond_mlp(observed)), dim=1)
        x, skipped = sample.transpose(1, 2), []
        down: Any = self.down_modules  # lists of modules, as torch does not say
        up: Any = self.up_modules
        for first, second, resize in down:
            x = second(first(x, condition), condition)
            skipped.append(x)
            x = resize(x)
        for block in self.mid_modules:
            x = block(x, condition)
        for first, second, resize in up:
            x = torch.cat((x, skipped.pop()), dim=1)
            x = resize(second(first(x, condition), condition))
        return self.final_conv(x).transpose(1, 2)  # type: ignore[no-any-return]
