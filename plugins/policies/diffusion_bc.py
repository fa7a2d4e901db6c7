"""Diffusion BC of Pearce et al.: one action a call, from an image or a state, by an MLP or a transformer of few tokens.

Their code saves results and no model, so what is read is what ``torch.save(model.state_dict(), path)`` writes of a
``Model_Cond_Diffusion``. Parameters are called as in the original. Sizes are those of the weights, and the schedule is
in buffers beside them. Diffusion-X goes on at the last timestep, without noise: it is asked for as more steps than the
training had. Diffusion-KDE draws many actions and takes the likeliest: a batch of streams, and a choice after it.

Source: ``code/models.py`` of microsoft/Imitating-Human-Behaviour-w-Diffusion (arXiv 2301.10677).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import loops_of
from ttscompile.frontends.saved_weights import as_float32, filled
from ttscompile.frontends.scheduler import MOST_STEPS, MOST_TIMESTEPS, configured_sampler

from .networks.layers import split

_SCALE = 1.414
"""What a sum of two is divided by."""
_SIDE, _POOLED = 32, 8
"""Pixels of an image of their data set, and rows that are left of it where it is averaged."""
_SCHEDULE = ("sqrt_beta_t", "alphabar_t")
_COMPUTED = ("alpha_t", "oneover_sqrta", "sqrtab", "sqrtmab", "mab_over_sqrtmab")
"""Buffers that follow from those, and are not read."""
_UNREAD = "num_batches_tracked"
_ENTRIES = ("model", "state_dict", "model_state_dict")
"""Under which the weights may be, where something else was saved beside them."""
_NET, _DOWN = "nn_model.", "nn_downstream."
_REMEDY = "Give what torch.save(model.state_dict(), path) writes of a Model_Cond_Diffusion."


class _Time(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.lin1, self.lin2 = nn.Linear(1, width, bias=False), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.lin2(torch.sin(self.lin1(x)))  # type: ignore[no-any-return]


class _Norm(nn.Module):
    """A batch norm after its training, without its count of batches."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))
        self.register_buffer("running_mean", torch.zeros(width))
        self.register_buffer("running_var", torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        scale = self.weight * torch.rsqrt(self.running_var + 1e-5)
        shift, shape = self.bias - self.running_mean * scale, (-1, *[1] * (x.ndim - 2))
        return x * scale.view(shape) + shift.view(shape)


class _Layer(nn.Module):
    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.model = nn.Sequential(nn.Linear(inputs, width), _Norm(width), nn.GELU())

    def forward(self, x: Tensor) -> Tensor:
        return self.model(x)  # type: ignore[no-any-return]


class _Attention(nn.Module):
    """The parameters of ``nn.MultiheadAttention``; query, key and value are thirds of what comes in."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.in_proj_weight = nn.Parameter(torch.zeros(3 * width, width))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * width))
        self.out_proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        weights, biases = self.in_proj_weight.chunk(3), self.in_proj_bias.chunk(3)
        q, k, v = (
            split(functional.linear(*each), self.heads) for each in zip(x.chunk(3, -1), weights, biases, strict=True)
        )
        seen = functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return self.out_proj(seen)  # type: ignore[no-any-return]


class _TransformerLayer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        inside = width * heads
        self.input_to_qkv1, self.multihead_attn1 = nn.Linear(width, 3 * inside), _Attention(inside, heads)
        self.attn1_to_fcn = nn.Linear(inside, width)
        self.attn1_fcn = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.norm1a, self.norm1b = _Norm(width), _Norm(width)

    def forward(self, x: Tensor) -> Tensor:
        seen = self.attn1_to_fcn(self.multihead_attn1(self.input_to_qkv1(x)))
        x = self.norm1a((seen / _SCALE + x / _SCALE).transpose(1, 2)).transpose(1, 2)
        x = self.attn1_fcn(x) / _SCALE + x / _SCALE
        return self.norm1b(x.transpose(1, 2)).transpose(1, 2)  # type: ignore[no-any-return]


class _Convolutions(nn.Module):
    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = (
            nn.Sequential(nn.Conv2d(before, width, 3, 1, 1), _Norm(width), nn.GELU()) for before in (channels, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        first = self.conv1(x)
        kept = x if x.shape[1] == first.shape[1] else first
        return (kept + self.conv2(first)) / _SCALE  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Sizes:
    """Of a network, as its weights have them.

    Attributes:
        state: numbers of what is observed at one time, or features of an image.
        times: that are observed: 2 where the last one is given beside the present one.
        hidden: width of the MLP; 0 for a transformer.
        tokens: width of the transformer's tokens, and its heads.
        image: channels, and features of the first convolution; none where there is no image.
        timesteps: of training.
    """

    state: int
    times: int
    actions: int
    embedded: int
    hidden: int
    tokens: tuple[int, int]
    image: tuple[int, int] | None
    timesteps: int

    @property
    def observed(self) -> tuple[str, ObservationSpec]:
        """Its key, and what it is."""
        if self.image is None:
            return "obs", ObservationSpec((self.state * self.times,))
        return "image", ObservationSpec((self.image[0], _SIDE, _SIDE), window=False, bounds=(0.0, 1.0))


class _Embedding(nn.Module):
    """``Model_mlp_diff_embed``: embeddings of state, action and time, then an MLP or a transformer of a token for each.

    The MLP is given action and time in every layer.
    """

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        width, actions, inputs = sizes.embedded, sizes.actions, 2 + sizes.times
        self.times, self.hidden = sizes.times, sizes.hidden
        self.x_embed_nn, self.y_embed_nn = (
            nn.Sequential(nn.Linear(count, width), nn.LeakyReLU(), nn.Linear(width, width))
            for count in (sizes.state, actions)
        )
        self.t_embed_nn = _Time(width)
        if self.hidden:
            again = self.hidden + actions + 1
            counts = (inputs * width, again, again)
            self.fc1, self.fc2, self.fc3 = (nn.Sequential(_Layer(count, self.hidden)) for count in counts)
            self.fc4 = nn.Sequential(nn.Linear(again, actions))
            return
        token, heads = sizes.tokens
        self.t_to_input, self.y_to_input, self.x_to_input = (nn.Linear(width, token) for _ in range(3))
        self.pos_embed = _Time(token)
        for number in range(1, 5):
            self.add_module(f"transformer_block{number}", _TransformerLayer(token, heads))
        self.final = nn.Linear(token * inputs, actions)

    def forward(self, y: Tensor, x: Tensor, t: Tensor) -> Tensor:
        """Noisy action ``[B, D]``, observation ``[B, X]``, time ``[B, 1]`` -> noise ``[B, D]``."""
        seen = [x] if self.times == 1 else x.chunk(self.times, -1)
        observed = [-self.x_embed_nn(each) for each in seen]  # the original multiplies by -1 what it does not mask
        action, time = self.y_embed_nn(y), self.t_embed_nn(t)
        if not self.hidden:
            return self._by_transformer(observed, action, time)
        first = self.fc1(torch.cat([*observed, action, time], 1)) / _SCALE
        second = (self.fc2(torch.cat([first, y, t], 1)) + first) / _SCALE
        third = self.fc3(torch.cat([second, y, t], 1)) + second
        return self.fc4(torch.cat([third, y, t], 1))  # type: ignore[no-any-return]

    def _by_transformer(self, observed: list[Tensor], action: Tensor, time: Tensor) -> Tensor:
        tokens = [self.t_to_input(time), self.y_to_input(action), *map(self.x_to_input, observed)]
        places = self.pos_embed(torch.arange(1, len(tokens) + 1, dtype=torch.float32)[:, None])
        x = torch.stack(tokens, 1) + places
        for number in range(1, 5):
            x = self.get_submodule(f"transformer_block{number}")(x)
        return self.final(x.flatten(1))  # type: ignore[no-any-return]


class _OfImages(nn.Module):
    """``Model_cnn_mlp``."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        channels, features = sizes.image or (0, 0)
        self.conv_down1 = nn.Sequential(_Convolutions(channels, features), nn.MaxPool2d(2))
        self.conv_down3 = nn.Sequential(_Convolutions(features, 2 * features), nn.MaxPool2d(2))
        self.nn_downstream = _Embedding(sizes)

    def forward(self, y: Tensor, x: Tensor, t: Tensor) -> Tensor:
        # The original turns its rows of pixels into columns.
        features = self.conv_down3(self.conv_down1(x.transpose(2, 3)))
        return self.nn_downstream(y, features[..., :_POOLED, :_POOLED].mean((2, 3)), t)  # type: ignore[no-any-return]


class DiffusionBC(nn.Module):
    """The network of ``Model_Cond_Diffusion`` without guidance; inputs ``sample [B, 1, D]``, ``timestep [B]``.

    Beside them it reads ``image [B, C, 32, 32]`` of 0..1, or ``obs [B, X]``.
    """

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.timesteps = sizes.timesteps
        self.nn_model = _Embedding(sizes) if sizes.image is None else _OfImages(sizes)

    def forward(
        self, sample: Tensor, timestep: Tensor, obs: Tensor | None = None, image: Tensor | None = None
    ) -> Tensor:
        """See the class."""
        observed = image if obs is None else obs
        time = timestep.float()[:, None] / self.timesteps
        return self.nn_model(sample[:, 0], observed, time)[:, None]  # type: ignore[no-any-return]


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from its weights; see ``Family.load``."""
    saved = _saved(path)
    betas, signal = _schedule(path, saved)
    weights = {name: value for name, value in saved.items() if name.startswith(_NET) and not name.endswith(_UNREAD)}
    known = {*weights, *_SCHEDULE, *_COMPUTED}
    if unknown := sorted(name for name in saved if name not in known and not name.endswith(_UNREAD)):
        raise CheckpointError(f"{path}: its entry {unknown[0]:.80} is none of a Model_Cond_Diffusion's. {_REMEDY}")
    sizes = replace(_sizes(path, weights), timesteps=len(betas) - 1)
    network = filled(lambda: DiffusionBC(sizes), as_float32(weights, f"{path}: "), "the first of each kind", path)
    loops = loops_of(lambda asked: _table(betas, signal, asked), options, "ddpm")
    spec = PolicySpec(
        sample=(1, sizes.actions),
        observations=dict([sizes.observed]),
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(sizes.actions, 0, 1),
        source={
            "format": "diffusion_bc",
            "policy": "Diffusion BC",
            "variant": "MLP" if sizes.hidden else "transformer",
            **loops.source,
        },
    )
    return network.eval(), spec


def _saved(path: Path) -> dict[str, Any]:
    payload = read_checkpoint(path)
    saved = next((payload[name] for name in _ENTRIES if isinstance(payload.get(name), Mapping)), payload)
    return {str(name).replace("_orig_mod.", "").removeprefix("module."): value for name, value in saved.items()}


def _schedule(path: Path, saved: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    """Betas, and shares of the action's variance, of the timesteps from 0 to the last one; the first is never given."""
    found = []
    for name in _SCHEDULE:
        value = saved.get(name)
        if not isinstance(value, Tensor) or value.ndim != 1 or not 2 < len(value) <= MOST_TIMESTEPS:
            shown = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else "none"
            raise CheckpointError(f"{path}: {name} is a vector of the timesteps; found {shown}. {_REMEDY}")
        if value.dtype not in (torch.float32, torch.float64):
            raise CheckpointError(
                f"{path}: {name} is a {value.dtype} tensor; expected torch.float32, since a schedule that is rounded so"
                " is another one. Make the Model_Cond_Diffusion anew with the betas of its training, load the weights"
                f" {_NET}* into it, and save that."
            )
        found.append(value.double())
    betas, signal = found[0] ** 2, found[1]
    if betas.shape != signal.shape or not ((betas > 0) & (betas < 1) & (signal > 0) & (signal < 1)).all():
        raise CheckpointError(f"{path}: sqrt_beta_t and alphabar_t are no schedule of DDPM. {_REMEDY}")
    return betas.tolist(), signal.tolist()


def _sizes(path: Path, weights: Mapping[str, Any]) -> Sizes:
    """Those that the weights have; whether all of them fit is asked later."""

    def shape(name: str) -> tuple[int, ...]:
        value = weights.get(f"{_NET}{name}")
        if not isinstance(value, Tensor) or value.ndim < 2 or not value.numel():
            raise CheckpointError(
                f"{path}: no weight {_NET}{name}; expected the network Model_cnn_mlp or Model_mlp_diff_embed. {_REMEDY}"
            )
        return tuple(value.shape)

    on_images = f"{_NET}conv_down1.0.conv1.0.weight" in weights
    first = shape("conv_down1.0.conv1.0.weight") if on_images else None
    below = _DOWN if on_images else ""
    embedded, state = shape(f"{below}x_embed_nn.0.weight")[:2]
    hidden, tokens = 0, (1, 1)
    if f"{_NET}{below}fc1.0.model.0.weight" in weights:
        hidden, read = shape(f"{below}fc1.0.model.0.weight")[:2]
        inputs = read // embedded
    else:
        width = shape(f"{below}t_to_input.weight")[0]
        tokens = width, max(1, shape(f"{below}transformer_block1.attn1_to_fcn.weight")[1] // width)
        inputs = shape(f"{below}final.weight")[1] // width
    return Sizes(
        state=state,
        times=2 if inputs == 4 else 1,
        actions=shape(f"{below}y_embed_nn.0.weight")[1],
        embedded=embedded,
        hidden=hidden,
        tokens=tokens,
        image=None if first is None else (first[1], first[0]),
        timesteps=1,
    )


def _table(betas: list[float], signal: list[float], options: LoadOptions) -> SamplerTable:
    """The loop that is asked for; without one their own, which goes on at the last timestep for steps beyond it."""
    trained = len(betas) - 1
    steps = trained if options.steps is None else options.steps
    if options.sampler in (None, "ddpm") and options.spacing is None and steps >= trained:
        return _own_table(np.array(betas), np.array(signal), steps)
    settings = {
        "_target_": f"diffusers.{'DDIM' if options.sampler == 'ddim' else 'DDPM'}Scheduler",
        "trained_betas": betas,
        "num_train_timesteps": len(betas),
        "clip_sample": False,
        "steps_offset": 1,
        "variance_type": "fixed_large",
    }
    if options.sampler == "ddim":
        del settings["variance_type"]
    table = configured_sampler(settings, trained, options, where="their schedule")
    # diffusers adds noise whenever it does not end at timestep 0; they never do in the last step.
    return replace(table, noise_to_next=np.append(table.noise_to_next[:-1], np.float32(0)))


def _own_table(betas: Any, signal: Any, steps: int) -> SamplerTable:
    """``sample``, and with more steps than those of training ``sample_extra``: Diffusion-X."""
    trained = len(betas) - 1
    if steps > MOST_STEPS:
        raise SpecError(f"{steps} denoising steps are not possible; expected {MOST_STEPS} at most.")
    at = np.maximum(np.arange(trained, trained - steps, -1), 1)
    beta, kept = betas[at], signal[at]
    columns = {
        "sample_to_x0": kept**-0.5,
        "out_to_x0": -(((1 - kept) / kept) ** 0.5),
        "x0_to_next": np.zeros(steps),
        "sample_to_next": (1 - beta) ** -0.5,
        "out_to_next": -beta / ((1 - kept) * (1 - beta)) ** 0.5,
        "noise_to_next": np.where(at > 1, beta**0.5, 0),
    }
    narrow = {name: column.astype(np.float32) for name, column in columns.items()}
    return SamplerTable("ddpm" if steps == trained else "diffusion-x", at, clip=None, **narrow)
