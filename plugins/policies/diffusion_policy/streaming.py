"""Streaming Diffusion Policy: configuration and weights to a denoiser whose sample is a buffer of chunks.

The first chunk of the buffer is nearly clean, and each one behind it is noisier. A call denoises all of them until the
first one is clean, which takes as many steps as one chunk is noisier than the next; it is executed, the buffer moves on
by it, and noise comes in at the end. So every position has its own timestep, and its own coefficients of the sampler.
They are tables here, and the denoiser gives the mean of the next sample; its samples are in units of the noise that
follows, so that one row of the sampler's table is for all positions.

What a call leaves is given to the next one as an observation: ``buffer``, the ``action_pred`` of the call before, and
``begins``, whether there was none. The noise of a call's last step is added by the next call, since all that is
executed of this one has none. After a first chunk the original calls the clean steps before the next one as noisy as
that is, and leaves them clean; so it is here.

Source: ``TEDiUnetLowdimPolicy``, ``TEDIUnetHybridImagePolicy`` and ``DDPMTEDiScheduler`` of
Streaming-Diffusion-Policy/streaming_diffusion_policy (Høeg et al., arXiv 2406.04806).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from torch import nn
from torch.nn import functional

from ttscompile.core.spec import ObservationSpec, SamplerTable
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.scheduler import MOST_STEPS
from ttscompile.frontends.settings import Settings

from ..networks.conditional_unet1d import ConditionalUnet1D, UNetConfig
from ..networks.transformer_for_diffusion import SinusoidalEmbedding
from .hybrid import ENCODER_KEYS, build_encoder
from .parts import (
    COMMON_KEYS,
    Rebuilt,
    Saved,
    affine,
    load_network,
    network_settings,
    network_weights,
    observation_specs,
    read_shape_meta,
    require_room,
    require_sizes,
)
from .unet import DEFAULTS

_NETWORK, _SCHEDULER = "ConditionalUnet1D", "DDPMTEDiScheduler"
_SIZES = frozenset({"input_dim", "local_cond_dim", "global_cond_dim", "diffusion_step_embed_dim", "down_dims"})
_SIZES |= {"kernel_size", "n_groups", "cond_predict_scale"}
_TRAINING = frozenset({"chunk_wise_weight", *(f"temporally_{how}" for how in ("constant_weight", "random_weights"))})
_TRAINING |= {"temporally_increasing_weight"}
_READ = frozenset({"obs_dim", "action_dim", "model", "obs_as_local_cond", "pred_action_steps_only"})
_READ |= {"oa_step_convention"}
_NETWORK_OF_IMAGES: Mapping[str, Any] = {**DEFAULTS, "cond_predict_scale": True}
_BUFFER = ("buffer", "begins")
"""What is observed of the call before."""
_RENAMED = {"model.diffusion_step_encoder.3.": 1, "model.diffusion_step_encoder.5.": 3}
"""Layers of the timesteps' encoder, which the original has behind two that only turn their arguments."""
_MOST_HORIZON = 4096
_CHANGED = "The policy was changed; use ttscompile.compile_denoiser(module, spec)."

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Buffer:
    """How a buffer is cut into chunks.

    Attributes:
        horizon: its steps.
        observed: steps that are observed, of which all but the last stand before the first chunk.
        executed: steps of a chunk.
        timesteps: of the training.
    """

    horizon: int
    observed: int
    executed: int
    timesteps: int

    @property
    def chunks(self) -> int:
        """Whole ones; what is left of the buffer is as noisy as the last of them."""
        return (self.horizon - self.observed + 1) // self.executed

    @property
    def steps(self) -> int:
        """K, by which each chunk is noisier than the one before it."""
        return self.timesteps // self.chunks

    @property
    def kept(self) -> int:
        """Steps at the beginning of a buffer that the call before has denoised."""
        return self.observed - 1 + (self.chunks - 1) * self.executed

    def levels(self) -> npt.NDArray[np.int64]:
        """The timestep of every position in every step, ``[K, T]``."""
        chunk = np.clip((np.arange(self.horizon) - self.observed + 1) // self.executed, 0, self.chunks - 1)
        return (chunk + 1) * self.steps - 1 - np.arange(self.steps)[:, None]


class _Levels(nn.Module):
    """The waves of all positions' timesteps, ``[B] -> [B, T * width]``."""

    table: torch.Tensor

    def __init__(self, levels: npt.NDArray[np.int64], width: int) -> None:
        super().__init__()
        waves = SinusoidalEmbedding(width)(torch.from_numpy(levels).flatten())
        self.register_buffer("table", waves.reshape(len(levels), -1), persistent=False)

    def forward(self, step: torch.Tensor) -> torch.Tensor:
        return self.table[step]


class StreamingDenoiser(nn.Module):
    """The mean of the next buffer.

    Inputs: ``sample [B, T, Da]``, ``timestep [B]``, ``obs [B, To, Do]``, ``buffer [B, T, Da]``, ``begins [B, 1]``. The
    timestep is the number of the step, from 0. At step 0 the sample is noise, of which the buffer takes what it needs.
    """

    def __init__(self, model: nn.Module, buffer: Buffer, scheduler: Any) -> None:
        super().__init__()
        self.model, self.executed = model, buffer.executed
        self.clips = bool(scheduler.config.clip_sample)
        tables = _tables(buffer.levels(), scheduler)
        for name, table in tables.items():
            self.register_buffer(name, torch.from_numpy(table[..., None].astype(np.float32)), persistent=False)
        there = np.arange(buffer.horizon) < buffer.kept
        # A chunk that is not the first one still lacks the noise of the step that the call before ended with.
        lacking = np.roll(tables["noise"][-1], -buffer.executed)
        for name, row in (("kept", there), ("drawn", np.where(there, lacking, 1.0))):
            self.register_buffer(name, torch.from_numpy(row[:, None].astype(np.float32)), persistent=False)

    def forward(
        self,
        sample: torch.Tensor,
        timestep: torch.Tensor,
        obs: torch.Tensor,
        buffer: torch.Tensor,
        begins: torch.Tensor,
    ) -> torch.Tensor:
        """See the class."""
        of: Any = self  # its tables, as torch does not say
        moved = functional.pad(buffer[:, self.executed :], (0, 0, 0, self.executed))
        first = torch.where(begins[..., None] > 0.5, of.empty[0] * sample, of.kept * moved + of.drawn * sample)
        x = torch.where((timestep == 0)[:, None, None], first, of.unit[timestep] * sample)
        predicted = self.model(x, timestep, global_cond=obs.flatten(1))
        clean = of.x_to_clean[timestep] * x + of.predicted_to_clean[timestep] * predicted
        clean = clean.clamp(-1, 1) if self.clips else clean
        mean = of.clean_to_mean[timestep] * clean + of.x_to_mean[timestep] * x
        following: torch.Tensor = mean / of.next_unit[timestep]
        return following


class _Observed(nn.Module):
    """All that a policy on images observes as one row, ``[B, To * width + T * Da + 1]``."""

    def __init__(self, encoder: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        others = {key: value for key, value in observations.items() if key not in _BUFFER}
        return torch.cat([self.encoder(others).flatten(1), *(observations[key].flatten(1) for key in _BUFFER)], 1)


class _OfRow(nn.Module):
    """The denoiser of such a row."""

    def __init__(self, denoiser: nn.Module, sizes: tuple[int, int, int]) -> None:
        super().__init__()
        self.denoiser, self.sizes = denoiser, sizes

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, row: torch.Tensor) -> torch.Tensor:
        obs, buffer, begins = torch.split(row, list(self.sizes), dim=-1)
        made: torch.Tensor = self.denoiser(sample, timestep, obs, torch.unflatten(buffer, -1, sample.shape[1:]), begins)
        return made


def low_dim(saved: Saved) -> Rebuilt:
    """``TEDiUnetLowdimPolicy``."""
    saved.settings.require(obs_as_local_cond=False, pred_action_steps_only=False, oa_step_convention=True)
    obs_dim, action_dim, observed, horizon = saved.sizes("obs_dim", "action_dim", "n_obs_steps", "horizon")
    values = network_settings(saved.config, _NETWORK, _SIZES | {"horizon"})
    own = values.pop("horizon", 16)
    if own != horizon:
        raise CheckpointError(f"cfg.policy.model.horizon is {own!r:.80}; expected {horizon}, the policy's.")
    if values.get("input_dim") is None:
        raise CheckpointError("cfg.policy.model.input_dim is missing; it is needed to rebuild the network.")
    config = UNetConfig(**{name: value for name, value in values.items() if name in _SIZES})
    expected = {"input_dim": action_dim, "global_cond_dim": obs_dim * observed, "local_cond_dim": None}
    require_sizes(config, expected, f"action_dim = {action_dim} and {observed} times obs_dim = {obs_dim}")
    specs = {"obs": ObservationSpec((observed, obs_dim), affine(saved.weights, "obs", obs_dim))}
    return _rebuilt(saved, config, action_dim, specs, None, _READ)


def on_images(saved: Saved) -> Rebuilt:
    """``TEDIUnetHybridImagePolicy``, with robomimic's encoder."""
    action_dim, observed = read_shape_meta(saved.settings, "low_dim", "rgb")
    if taken := sorted(observed.keys() & set(_BUFFER)):
        raise saved.settings.error(
            f"shape_meta.obs names {taken[0]}, which stands for the buffer here; expected others"
        )
    encoder = build_encoder(saved.settings, observed, saved.weights)
    (steps,) = saved.sizes("n_obs_steps")
    network = {name: saved.policy.get(name, default) for name, default in _NETWORK_OF_IMAGES.items()}
    config = UNetConfig(input_dim=action_dim, global_cond_dim=encoder.width * steps, **network)
    specs = observation_specs(observed, steps, saved.weights)
    return _rebuilt(saved, config, action_dim, specs, encoder, ENCODER_KEYS | frozenset(network))


def _rebuilt(
    saved: Saved,
    config: UNetConfig,
    action_dim: int,
    specs: dict[str, ObservationSpec],
    encoder: nn.Module | None,
    read: frozenset[str],
) -> Rebuilt:
    """The policy; ``read`` are its settings that were read already."""
    settings, known = saved.settings, read | _TRAINING | {"obs_as_global_cond", "buffer_init"}
    if not settings.flag("obs_as_global_cond", encoder is not None):
        raise settings.error("obs_as_global_cond is false; expected true: its inpainting is not rebuilt")
    if settings.values.get("buffer_init", "zero") not in ("zero", "constant"):  # alike where nothing is inpainted
        raise settings.refusal("buffer_init", "zero or constant: the first call of an episode would have other steps")
    if unknown := sorted(set(saved.policy) - {*known, *COMMON_KEYS}):
        raise CheckpointError(f"cfg.policy has settings that are not known: {', '.join(unknown)}. {_CHANGED}")
    observed, executed = saved.sizes("n_obs_steps", "n_action_steps")
    horizon, scheduler = settings.number("horizon", most=_MOST_HORIZON), _scheduler(saved)
    buffer = Buffer(horizon, observed, executed, int(scheduler.config.num_train_timesteps))
    if buffer.chunks < 1 or buffer.timesteps % buffer.chunks:
        told = f"{buffer.chunks} chunks of n_action_steps = {executed}, and {buffer.timesteps} timesteps"
        raise settings.error(
            f"horizon = {horizon} holds {told}; expected one chunk at least, and timesteps that they divide: else calls"
            " take different numbers of steps"
        )
    module: nn.Module = StreamingDenoiser(_network(saved, buffer, config), buffer, scheduler)
    if encoder is not None:
        sizes = (config.global_cond_dim or 0, horizon * action_dim, 1)
        module = EncodedDenoiser(_Observed(encoder), _OfRow(module, sizes))
    buffered = ObservationSpec((horizon, action_dim), affine(saved.weights, "action", action_dim), window=False)
    return Rebuilt(
        module,
        specs | dict(zip(_BUFFER, (buffered, ObservationSpec((1,), bounds=(0.0, 1.0))), strict=True)),
        (horizon, action_dim),
        action_dim,
        observed - 1,
        "streaming",
        known,
        lambda options: _loop(buffer, options),
    )


def _network(saved: Saved, buffer: Buffer, config: UNetConfig) -> ConditionalUnet1D:
    if buffer.horizon % config.divisor:
        raise saved.settings.error(f"horizon is {buffer.horizon}; expected a multiple of {config.divisor}")
    width, dims = config.diffusion_step_embed_dim, config.down_dims
    needed = {
        "diffusion_step_embed_dim or horizon": 4 * width * width * buffer.horizon,
        "down_dims or kernel_size": config.kernel_size * sum(n * n for n in dims),
    }
    weights = {_renamed(name): value for name, value in network_weights(saved.weights).items()}
    require_room(needed, weights)
    network = ConditionalUnet1D(config)
    network.diffusion_step_encoder = nn.Sequential(
        _Levels(buffer.levels(), width),
        nn.Linear(buffer.horizon * width, 4 * width),
        nn.Mish(),
        nn.Linear(4 * width, width),
    )
    load_network(network, weights)
    return network


def _renamed(name: str) -> str:
    for old, place in _RENAMED.items():
        if name.startswith(old):
            return f"model.diffusion_step_encoder.{place}.{name.removeprefix(old)}"
    return name


def _scheduler(saved: Saved) -> Any:
    """A scheduler of diffusers with the same betas, checked against what the original does with them."""
    where = f"{saved.settings.where}noise_scheduler."
    settings = Settings(saved.policy["noise_scheduler"], where)
    found = str(settings.values.get("_target_")).rpartition(".")[2]
    if found != _SCHEDULER:
        raise CheckpointError(
            f"{where}_target_ is {found:.80}; expected {_SCHEDULER}. With DDIM the original takes the levels of its"
            " buffer for timesteps of the training, of which there are more."
        )
    trained = settings.number("num_train_timesteps", 1000, MOST_STEPS)
    steps = saved.policy.get("num_inference_steps")
    if steps not in (None, trained):
        raise saved.settings.refusal(
            "num_inference_steps", f"{trained}, the timesteps of the training: the original takes levels for timesteps"
        )
    settings.choice("variance_type", "fixed_small", "fixed_small_log", "fixed_large")
    settings.choice("prediction_type", "epsilon", "sample", "v_prediction")
    settings.flag("clip_sample", True)
    given = {name: value for name, value in settings.values.items() if name != "_target_"}
    try:
        return DDPMScheduler(**given)
    except Exception as error:  # settings of a wrong type fail wherever diffusers first uses them
        told = f"{type(error).__name__}: {error!s:.200}"
        raise CheckpointError(f"{where[:-1]}: diffusers refuses the settings {given!s:.300}: {told}") from error


def _tables(levels: npt.NDArray[np.int64], scheduler: Any) -> dict[str, Array]:
    """Coefficients ``[K, T]`` of a step of every position at its timestep, and the units of its samples.

    A sample is in units of the noise that was added to it, and what a call begins and ends with in units of 1.
    """
    signal = scheduler.alphas_cumprod.double().numpy()
    betas, before = scheduler.betas.double().numpy(), np.append(1.0, signal)[levels]
    kept, beta, predicts = signal[levels], betas[levels], scheduler.config.prediction_type
    noise = 1 - kept
    to_clean = {
        "epsilon": (kept**-0.5, -((noise / kept) ** 0.5)),
        "sample": (np.zeros(kept.shape), np.ones(kept.shape)),
        "v_prediction": (kept**0.5, -(noise**0.5)),
    }
    small = np.maximum((1 - before) / noise * beta, 1e-20)
    variance = beta if scheduler.config.variance_type == "fixed_large" else small
    added = np.where(levels > 0, variance**0.5, 0.0)
    unit = np.concatenate([np.ones_like(kept[:1]), added[:-1]])
    x_to_clean, predicted_to_clean = to_clean[predicts]
    return {
        "x_to_clean": x_to_clean,
        "predicted_to_clean": predicted_to_clean,
        "clean_to_mean": before**0.5 * beta / noise,
        "x_to_mean": (1 - beta) ** 0.5 * (1 - before) / noise,
        "noise": added,
        "unit": unit,
        "next_unit": np.concatenate([unit[1:], np.ones_like(kept[:1])]),
        "empty": noise**0.5,
    }


def _loop(buffer: Buffer, options: LoadOptions) -> SamplerTable:
    """K steps, whose predictions are the means of the next samples."""
    if options.sampler is not None or options.spacing is not None or options.steps not in (None, buffer.steps):
        raise SpecError(
            f"Streaming Diffusion Policy has one loop: its buffer is cleaner by {buffer.steps} steps after each call."
            " Leave sampler, steps and timestep spacing out."
        )
    steps = np.arange(buffer.steps)
    columns = {name: np.zeros(len(steps), np.float32) for name in SamplerTable.COLUMNS}
    columns["out_to_next"] += 1
    columns["noise_to_next"][:-1] = 1
    return SamplerTable("streaming", steps, clip=None, **columns)
