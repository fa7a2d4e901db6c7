"""DPPO's policies on states, before and after fine-tuning, with the configuration that hydra wrote beside them.

Loop and weights are those of the original's evaluation, ``deterministic=True``: DDIM draws nothing in its steps, and
DDPM keeps its own noise, without the larger one (``min_sampling_denoising_std``) that explores in training.

Source: ``DiffusionModel``, ``PPODiffusion`` and ``DiffusionEval`` of irom-princeton/dppo at cc7234a (Ren et al., arXiv
2409.00588), and the wrappers of its environments.
"""

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from ttscompile.core.spec import Affine, ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.core.zip_files import open_zip
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.loops import Loops
from ttscompile.frontends.saved_weights import as_float32, filled
from ttscompile.frontends.scheduler import MOST_TIMESTEPS, configured_loops
from ttscompile.frontends.settings import Settings

from .diffusion_policy.interpolation import Config
from .last_step import changed, clipped
from .networks.dppo import ACTIVATIONS, DiffusionMLP, MLPConfig, Unet1D, UnetConfig
from .yaml_files import read_yaml

CONFIG, NORMALIZATION = Path(".hydra") / "config.yaml", "normalization.npz"
"""Hydra writes the one into the folder of a training; the other is beside the data set, and its copy is looked for."""

_REMEDY = "Give what the training saved, with its own .hydra/config.yaml."
_MOST, _MOST_LAYERS, _MOST_STEPS, _MOST_BYTES = 2**14, 64, 4096, 2**20
_UNREAD = ("network_path", "device", "critic", "eta", "network", "actor")
"""Of ``model``: what names files and machines, or is read on its own."""
_FAR = 6.0
"""Deviations beyond which no noise lies."""


class DPPODenoiser(nn.Module):
    """One network for the last timesteps and another one for those before them.

    Args:
        before: for timesteps from ``threshold`` on; None where there are none.
        after: for those below it.
    """

    def __init__(self, before: nn.Module | None, after: nn.Module, threshold: int) -> None:
        super().__init__()
        self.before, self.after, self.threshold = before, after, threshold

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        observed = state.flatten(1)
        found = self.after(sample, timestep, observed)
        if self.before is None:
            return found  # type: ignore[no-any-return]
        early = (timestep >= self.threshold)[:, None, None]
        return torch.where(early, self.before(sample, timestep, observed), found)


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild a policy from ``checkpoint/state_N.pt`` and the configuration of its training; see ``Family.load``."""
    where = next(p / CONFIG for p in path.parents[:2] if (p / CONFIG).is_file())
    try:
        config = Config(read_yaml(where))
        settings = Settings(_resolved(config), f"{where}: model.", _REMEDY)
        kind = str(settings.values.get("_target_")).rpartition(".")[2]
        if kind not in ("DiffusionModel", "PPODiffusion"):
            raise settings.refusal("_target_", "DiffusionModel or PPODiffusion, which denoise and are rebuilt here")
        loops = _loops(settings, options, str(where))
        sizes = settings.number("horizon_steps", most=_MOST_STEPS), settings.number("action_dim", most=_MOST)
        top = Settings({name: config.get(name) for name in ("cond_steps", "act_steps")}, f"{where}: ", _REMEDY)
        steps, width = top.number("cond_steps", most=_MOST_STEPS), settings.number("obs_dim", most=_MOST)
        executed = min(sizes[0] if top.values["act_steps"] is None else top.number("act_steps"), sizes[0])
    except CheckpointError as error:
        raise CheckpointError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error
    module = _module(path, settings, kind, sizes, steps * width)
    observed, acted = _normalizers(path, config, width, sizes[1])
    spec = PolicySpec(
        sample=sizes,
        observations={"state": ObservationSpec((steps, width), observed)},
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(sizes[1], 0, executed, normalizer=acted),
        source={"format": "dppo", "policy": kind, **loops.source},
    )
    return module.eval(), spec


def _resolved(config: Config) -> dict[str, Any]:
    """The entries of ``model``; of its network under ``network``, whatever that is called."""
    model = config.tree.get("model")
    if not isinstance(model, Mapping):
        raise CheckpointError(f"model is a {type(model).__name__}; expected settings by name. {_REMEDY}")
    found = {name: config.get(f"model.{name}") for name in model if name not in _UNREAD}
    return found | {"network": config.get("model.actor" if "actor" in model else "model.network")}


def _loops(settings: Settings, options: LoadOptions, where: str) -> Loops:
    """The loop of the evaluation, and what is asked for beside it.

    Its least deviation of DDPM's noise, 0.001, is below that of any step of 1,000 timesteps or fewer: it does nothing.
    """
    ddim, predicts = settings.flag("use_ddim", False), settings.flag("predict_epsilon", True)
    timesteps = settings.number("denoising_steps", 100, MOST_TIMESTEPS)
    steps = settings.number("ddim_steps", most=timesteps) if ddim else timesteps
    if ddim and not predicts:
        raise settings.error("predict_epsilon is false with use_ddim; expected true; the original refuses this, too")
    if ddim and settings.values.get("eps_clip_value") is not None:
        raise settings.refusal("eps_clip_value", "null: a noise that is bounded is no linear step of a sampler")
    bound, last = (_bound(settings, name, default) for name, default in _BOUNDS.items())
    if bound is not None and last is not None and last < bound:
        raise settings.error(f"final_action_clip_value is {last}; expected denoised_clip_value, {bound}, or more")
    scheduler = {
        "_target_": f"diffusers.{'DDIM' if ddim else 'DDPM'}Scheduler",
        "num_train_timesteps": timesteps,
        "beta_schedule": "squaredcos_cap_v2",
        "prediction_type": "epsilon" if predicts else "sample",
        "clip_sample": bound is not None,
        "clip_sample_range": 1.0 if bound is None else bound,
    }
    arguments = {"use_clipped_model_output": True} if ddim and bound is not None else {}
    loops = configured_loops(scheduler, steps, options, step_arguments=arguments, where=f"{where}: model")
    if not ddim:
        loops = replace(loops, original=_as_rounded(loops.original, predicts))
    _tell_of_noise(settings, ddim)
    return loops if bound is not None or last is None else changed(loops, lambda table: clipped(table, last))


def _as_rounded(table: SamplerTable, predicts: bool) -> SamplerTable:
    """The table of DDPM in the original's own float32: ``1 / share - 1``, next to 0, is off by as much as 0.1 %."""
    steps = table.steps
    place = np.linspace(0, steps + 1, steps + 1) / (steps + 1)
    whole = np.cos((place + 0.008) / 1.008 * np.pi * 0.5) ** 2
    betas = torch.tensor(np.clip(1 - whole[1:] / whole[:-1], 0, 0.999), dtype=torch.float32)
    share = torch.cumprod(1 - betas, 0)
    before = torch.cat((torch.ones(1), share[:-1]))
    columns = {
        "x0_to_next": betas * before.sqrt() / (1 - share),
        "sample_to_next": (1 - before) * (1 - betas).sqrt() / (1 - share),
        "noise_to_next": (betas * (1 - before) / (1 - share)).sqrt(),
    }
    if predicts:
        columns |= {"sample_to_x0": (1 / share).sqrt(), "out_to_x0": -(1 / share - 1).sqrt()}
    turned: Any = {name: column.flip(0).numpy() for name, column in columns.items()}
    return replace(table, **turned)


_BOUNDS: Mapping[str, float | None] = {"denoised_clip_value": 1.0, "final_action_clip_value": None}


def _bound(settings: Settings, name: str, default: float | None) -> float | None:
    value = settings.values.get(name, default)
    if value is not None and (type(value) not in (int, float) or not 0 < value < math.inf):
        raise settings.refusal(name, "a positive number or null")
    return None if value is None else float(value)


def _tell_of_noise(settings: Settings, ddim: bool) -> None:
    bound = _bound(settings, "randn_clip_value", 10.0)
    if not ddim and bound is not None and bound < _FAR:
        share = math.erfc(bound / math.sqrt(2))
        warnings.warn(
            f"{settings.where}randn_clip_value: the original bounds the noise of its steps at {bound:g}, beyond which"
            f" {share:.2%} of the numbers are. The compiled policy does not; noise that you give it may be bounded so.",
            stacklevel=4,
        )


def _module(path: Path, settings: Settings, kind: str, sample: tuple[int, int], observed: int) -> nn.Module:
    """The networks with their weights, and which of them is evaluated when."""
    saved = read_checkpoint(path).get("model")
    if not isinstance(saved, dict):
        found = type(saved).__name__
        raise CheckpointError(f"{path}: its entry 'model' is a {found}; expected weights by name. {_REMEDY}")
    weights = as_float32(saved, f"{path}: ")

    def network(prefix: str) -> nn.Module:
        own = {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}
        return filled(lambda: _network(settings.part("network"), sample, observed), own, "model.network", path)

    if kind == "DiffusionModel":
        return DPPODenoiser(None, network("network."), 0)
    if settings.values.get("ft_denoising_steps_d", 0) != 0:
        raise settings.refusal("ft_denoising_steps_d", "0: what is annealed is not saved")
    timesteps, tuned = settings.number("denoising_steps", 100), settings.number("ft_denoising_steps", least=0)
    steps = settings.number("ddim_steps") if settings.flag("use_ddim", False) else timesteps
    if tuned > steps:
        raise settings.error(f"ft_denoising_steps is {tuned}; expected {steps} at most")
    if not tuned:
        return DPPODenoiser(None, network("actor."), 0)
    before = network("actor.") if tuned < steps else None
    return DPPODenoiser(before, network("actor_ft."), (tuned - 1) * (timesteps // steps) + 1)


def _network(settings: Settings, sample: tuple[int, int], observed: int) -> nn.Module:
    kind = str(settings.values.get("_target_")).rpartition(".")[2]
    if kind not in ("DiffusionMLP", "Unet1D"):
        raise settings.refusal("_target_", "DiffusionMLP or Unet1D; those that see images are not rebuilt here")
    expected = {"action_dim": sample[1], "horizon_steps": sample[0], "cond_dim": observed}
    for name, value in expected.items():
        if settings.values.get(name, value) != value:
            raise settings.refusal(name, f"{value}, as the rest of the configuration says")
    activation = settings.choice("activation_type", *ACTIVATIONS)
    encoded = _widths(settings, "cond_mlp_dims", [])
    if kind == "DiffusionMLP":
        hidden, residual = _widths(settings, "mlp_dims", [256, 256]), settings.flag("residual_style", False)
        if not hidden or (residual and len(hidden) % 2 == 0):
            raise settings.refusal("mlp_dims", "widths, an odd number of them with residual_style", [256, 256])
        time = settings.number("time_dim", 16, _MOST, 4)
        last, norms = settings.choice("out_activation_type", "Identity", *ACTIVATIONS), "use_layernorm"
        normed = settings.flag(norms, False)
        return DiffusionMLP(MLPConfig(sample, observed, time, hidden, encoded, activation, last, normed, residual))
    if encoded and len(encoded) % 2:
        raise settings.refusal("cond_mlp_dims", "an even number of widths")
    return Unet1D(_unet(settings, sample, observed, encoded, activation))


def _unet(
    settings: Settings, sample: tuple[int, int], observed: int, encoded: tuple[int, ...], activation: str
) -> UnetConfig:
    width, times = settings.number("dim", 32, _MOST), _widths(settings, "dim_mults", [1, 2, 4, 8])
    groups = None if settings.values.get("n_groups") is None else settings.number("n_groups", most=_MOST)
    epsilon = settings.values.get("groupnorm_eps", 1e-5)
    if type(epsilon) is not float or not 0 < epsilon < 1:
        raise settings.refusal("groupnorm_eps", "a small number")
    if not times or times[0] != 1 or max(times) * width > _MOST or (groups is not None and width % groups):
        raise settings.error(f"dim is {width} with dim_mults = {list(times)}; expected widths that n_groups divides")
    if sample[0] % 2 ** (len(times) - 1):
        raise settings.error(f"a U-Net of {len(times)} levels halves the chunk's {sample[0]} steps: they do not divide")
    if activation not in ("Mish", "ReLU") or settings.number("kernel_size", 5, _MOST) % 2 == 0:
        raise settings.error("activation_type or kernel_size is another than the original can run: Mish or ReLU, odd")
    return UnetConfig(
        actions=sample[1],
        observed=observed,
        time=settings.number("diffusion_step_embed_dim", 32, _MOST, 4),
        encoded=encoded,
        channels=tuple(width * each for each in times),
        kernel=settings.number("kernel_size", 5),
        groups=groups,
        epsilon=epsilon,
        activation=activation,
        deep=not encoded and not settings.flag("smaller_encoder", False),
        scales=settings.flag("cond_predict_scale", False),
    )


def _widths(settings: Settings, name: str, default: list[int]) -> tuple[int, ...]:
    values = settings.values.get(name)
    values = default if values is None else values
    whole = isinstance(values, list) and all(type(each) is int and 1 <= each <= _MOST for each in values)
    if not whole or len(values) > _MOST_LAYERS:
        raise settings.refusal(name, f"widths up to {_MOST}, {_MOST_LAYERS} of them at most")
    return tuple(values)


def _normalizers(path: Path, config: Config, width: int, actions: int) -> tuple[Affine | None, Affine | None]:
    """What the wrapper of the environment does to observations and actions: from -1..1 of the data set, and to it."""
    file = next((p / NORMALIZATION for p in path.parents[:2] if (p / NORMALIZATION).is_file()), None)
    if file is None:
        warnings.warn(
            f"{path.parents[1] / NORMALIZATION}: no such file, so the policy takes observations, and gives actions, as"
            " the wrapper of the environment hands them over: in -1..1. Copy the file from the folder of the data set,"
            " and convert again.",
            stacklevel=4,
        )
        return None, None
    if config.get("env.wrappers.robomimic_lowdim.clamp_obs", False):
        raise CheckpointError(f"{path}: clamp_obs of the wrapper is not false; observations are not bounded here.")
    try:
        ends = _ends(file)
        for name, each in ends.items():
            if each.shape != (width if name.startswith("obs") else actions,) or not np.isfinite(each).all():
                raise CheckpointError(f"{file}: {name} has the shape {each.shape}; expected a number of each channel.")
        seen = 2 / (ends["obs_max"] - ends["obs_min"] + 1e-6)
        with np.errstate(divide="ignore", invalid="ignore"):  # of a channel that never moved, which is no Affine
            acted = 2 / (ends["action_max"] - ends["action_min"])
            pairs = (seen, ends["obs_min"]), (acted, ends["action_min"])
            observed, action = (Affine(each.astype("f4"), (-1 - each * low).astype("f4")) for each, low in pairs)
    except SpecError as error:
        raise CheckpointError(f"{file}: {error} Copy the file again.") from error
    return observed, action


_ENDS = ("obs_min", "obs_max", "action_min", "action_max")


def _ends(path: Path) -> dict[str, npt.NDArray[np.float64]]:
    """The ends of the ranges, of an ``.npz`` in which nothing is unpickled or unpacked beyond what they take."""
    found = {}
    try:
        with path.open("rb") as file, open_zip(file) as archive:
            for name in _ENDS:
                if archive.getinfo(f"{name}.npy").file_size > _MOST_BYTES:
                    raise ValueError(f"{name} has more than {_MOST_BYTES:,} bytes")
                with archive.open(f"{name}.npy") as entry:
                    found[name] = np.lib.format.read_array(entry, allow_pickle=False).astype(np.float64)
    except Exception as error:  # what the two readers raise depends on where the file is damaged
        told = f"not the ranges of a data set of DPPO, or damaged ones: {error!s:.200}"
        raise CheckpointError(f"{path}: {told}. Copy the file again.") from error
    return found
