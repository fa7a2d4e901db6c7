"""Consistency Policy: the loops of its teacher and its student, and configuration and weights to the networks in them.

Their checkpoints have the form of Diffusion Policy's, with robomimic's encoder. The teacher is the U-Net of that under
EDM: ``c_skip x + c_out F(c_in x, 250 log t)`` is the clean sample, and a Runge-Kutta method follows dx/dt from time_max
to time_min, not to 0. The student's F is told the time that it jumps to as well, which is always time_min: what that
gives is a constant beside the observation. It evaluates once, or again after noise of each of chaining_times.

Source: ``KarrasUnetHybridImagePolicy`` and ``CTMPPUnetHybridImagePolicy`` of Aaditya-Prasad/consistency-policy (Prasad
et al., arXiv 2405.07503); Karras et al., arXiv 2206.00364; Kim et al., arXiv 2310.02279.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from ttscompile.core.spec import SamplerTable
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.scheduler import MOST_STEPS
from ttscompile.frontends.settings import Settings
from ttscompile.samplers.flow import deterministic_table

from ..networks.conditional_unet1d import ConditionalUnet1D, UNetConfig
from .hybrid import ENCODER_KEYS, build_encoder
from .parts import COMMON_KEYS, Rebuilt, Saved, network_weights, observation_specs, read_shape_meta
from .unet import DEFAULTS, denoiser

_SCALE = 250.0
"""Of the logarithm of a time, as the network is given it."""
_LEAST = 1e-44
"""Added to a time before its logarithm is taken."""
_NETWORK: Mapping[str, Any] = {**DEFAULTS, "diffusion_step_embed_dim": 128, "cond_predict_scale": True}
_KNOWN = frozenset({*_NETWORK, *ENCODER_KEYS, "obs_as_global_cond", "delta", "inference_mode"})
_LEVELS = ("time_min", "time_max", "rho", "data_std")
_TRAINING = frozenset({"time_sampler", "P_std", "P_mean", "weighting", "alpha", "friction", "beta", "name"})
_ONLY_STUDENT = frozenset(
    {"dropout_rate", "initial_ema_decay", "special_skip", "teacher_path", "use_kde", "kde_samples", "edm", "losses"}
    | {"dsm_weights", "ctm_sampler", "chaining_times"}
)
_CHANGED = "The policy was changed; use ttscompile.compile_denoiser(module, spec)."

Times = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Method:
    """An explicit Runge-Kutta method.

    Attributes:
        nodes: where in a step each evaluation is, from 0 to 1.
        weights: of the slopes so far in the sample of the next evaluation, the last one's in the next step's.
        adds: whether the time at node 1 is the step added to the first one, and not the next one itself, which may
            differ in the last bit: as in the original.
    """

    name: str
    nodes: tuple[float, ...]
    weights: tuple[tuple[float, ...], ...]
    adds: bool = False


_EULER = Method("edm-euler", (0,), ((1,),))
_HEUN = Method("edm-heun", (0, 1), ((1,), (1 / 2, 1 / 2)))
_RK3 = Method("edm-rk3", (0, 1, 1 / 2), ((1,), (1 / 4, 1 / 4), (1 / 6, 1 / 6, 2 / 3)))
_RK4 = Method("edm-rk4", (0, 1 / 2, 1 / 2, 1), ((1 / 2,), (0, 1 / 2), (0, 0, 1), (1 / 6, 1 / 3, 1 / 3, 1 / 6)), True)
_SOLVERS = {"euler": _EULER, "first_order": _EULER, "heun": _HEUN, "second_order": _HEUN, "third": _RK3, "fourth": _RK4}
_ASKED = {"euler": _EULER, "rk4": _RK4}
"""What ``--sampler`` takes in place of the checkpoint's solver."""


@dataclass(frozen=True)
class Levels:
    """The noise levels of a policy, and how its network is scaled at each; times are float32, as the original's.

    Attributes:
        boundary: whether the clean sample at time_min is the sample itself.
    """

    time_min: float
    time_max: float
    rho: float
    data_std: float
    bins: int
    boundary: bool

    def times(self, bins: Sequence[float], count: int) -> Times:
        """Of bins among so many, from time_max at bin 0 to time_min at the last."""
        first, last = (each ** (1 / self.rho) for each in (self.time_max, self.time_min))
        # One by one: torch rounds an array's powers otherwise, and the network looks at the last digit of a time.
        roots = [first + torch.tensor(each) / (count - 1) * (last - first) for each in bins]
        return np.array([(each**self.rho).clamp(self.time_min, self.time_max).item() for each in roots])

    def scalings(self, times: Times) -> tuple[Times, Times]:
        """Shares of the sample and of what the network gives in the clean sample."""
        since = times - self.time_min if self.boundary else times
        skip = self.data_std**2 / (since**2 + self.data_std**2)
        return skip, since * self.data_std / np.hypot(times, self.data_std)


def _told(times: Times) -> Times:
    """What the network is given of times."""
    return np.array(
        [(_SCALE * torch.log(torch.tensor(each) + _LEAST)).item() for each in times.astype(np.float32).tolist()]
    )


class LevelDenoiser(nn.Module):
    """The network with its input scaled to a deviation of 1, and the observation as its condition.

    Args:
        stop: what the network makes of the time that it jumps to, ``[1, C]``; empty for a teacher.
    """

    stop: torch.Tensor

    def __init__(self, model: ConditionalUnet1D, data_std: float, stop: torch.Tensor) -> None:
        super().__init__()
        self.model = model
        self.variance = data_std**2
        self.register_buffer("stop", stop, persistent=False)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """``[B, T, Da]``, 250 log of the time ``[B]``, normalised ``[B, To, Do]`` -> ``[B, T, Da]``."""
        scale = torch.rsqrt(torch.exp(timestep * (2 / _SCALE)) + self.variance)
        condition = torch.cat((self.stop.expand(sample.shape[0], -1), obs.flatten(1)), dim=-1)
        return self.model(scale[:, None, None] * sample, timestep, global_cond=condition)  # type: ignore[no-any-return]


def teacher(saved: Saved) -> Rebuilt:
    """``KarrasUnetHybridImagePolicy``."""
    levels, settings = _levels(saved, "Karras_Scheduler", frozenset())
    solver = settings.values.get("solver")
    if solver not in tuple(_SOLVERS):
        draws = "; second_order_corr draws a velocity and noise in each step, which no table says"
        raise settings.refusal("solver", " or ".join(_SOLVERS) + draws)

    def loop(options: LoadOptions) -> SamplerTable:
        _refuse_spacing(options)
        if options.sampler is not None and options.sampler not in _ASKED:
            raise SpecError(
                f"sampler {options.sampler!r} is none of a teacher of Consistency Policy, which follows EDM's ordinary"
                f" differential equation; expected {' or '.join(_ASKED)}, or none for its own, {solver}."
            )
        steps = levels.bins - 1 if options.steps is None else options.steps
        if steps > MOST_STEPS:
            raise SpecError(f"{steps} denoising steps are not possible; expected {MOST_STEPS} at most.")
        method = _SOLVERS[solver] if options.sampler is None else _ASKED[options.sampler]
        return edm_table(levels, steps, method)

    return _rebuilt(saved, levels, None, loop, _KNOWN)


def student(saved: Saved) -> Rebuilt:
    """``CTMPPUnetHybridImagePolicy``."""
    levels, _ = _levels(saved, "CTM_Scheduler", frozenset({"ode_steps_max"}))
    if saved.settings.flag("use_kde", False):
        raise saved.settings.error("use_kde is true: the original draws kde_samples and takes the likeliest of them")
    again = _chaining_times(saved.settings, levels)

    def loop(options: LoadOptions) -> SamplerTable:
        _refuse_spacing(options)
        if options.sampler is not None:
            raise SpecError(
                f"sampler {options.sampler!r} is none of a student of Consistency Policy, which jumps to the actions;"
                " leave it out, and say with steps how often its network is evaluated."
            )
        steps = 1 if options.steps is None else options.steps
        possible = sorted({1, 1 + len(again)})
        if steps not in possible:
            expected = " or ".join(map(str, possible))
            raise SpecError(
                f"{steps} evaluations are not possible; expected {expected}: the student's network is evaluated once,"
                f" and once more for each of cfg.policy.chaining_times, of which there are {len(again)}."
            )
        return jump_table(levels, again[: steps - 1])

    weights = {key: each for key, each in saved.weights.items() if not key.startswith(("teacher.", "model_ema."))}
    return _rebuilt(Saved(saved.config, saved.settings, weights), levels, levels.time_min, loop, _KNOWN | _ONLY_STUDENT)


def _refuse_spacing(options: LoadOptions) -> None:
    if options.spacing is not None:
        raise SpecError("timestep spacing is for diffusers' schedulers; Consistency Policy has times of its own.")


def _rebuilt(saved: Saved, levels: Levels, stop: float | None, loop: Any, known: frozenset[str]) -> Rebuilt:
    """The policy; ``stop`` is the time that a student jumps to."""
    settings = saved.settings
    if unknown := sorted(set(saved.policy) - known - COMMON_KEYS):
        names = ", ".join(unknown)
        raise CheckpointError(f"cfg.policy has settings that Consistency Policy does not know: {names}. {_CHANGED}")
    if not settings.flag("obs_as_global_cond", True):
        found = "the original puts the observation into the sample once a step, not before every evaluation"
        raise settings.error(f"obs_as_global_cond is false; expected true: {found}, which is not rebuilt")
    action_dim, observed = read_shape_meta(settings, "low_dim", "rgb")
    encoder = build_encoder(settings, observed, saved.weights)
    (n_obs_steps,) = saved.sizes("n_obs_steps")
    network = {name: saved.policy.get(name, default) for name, default in _NETWORK.items()}
    width = settings.number("diffusion_step_embed_dim", _NETWORK["diffusion_step_embed_dim"])
    beside = 0 if stop is None else width
    config = UNetConfig(input_dim=action_dim, global_cond_dim=encoder.width * n_obs_steps + beside, **network)
    weights, start = network_weights(saved.weights), n_obs_steps - 1
    given, sample = denoiser(saved, weights, config, "global condition", action_dim, "horizon", start)
    unet: Any = given.model
    encoded = torch.zeros(1, 0)
    if stop is not None:
        with torch.no_grad():
            encoded = unet.diffusion_step_encoder(torch.from_numpy(_told(np.array([stop]))).float())
    return Rebuilt(
        EncodedDenoiser(encoder, LevelDenoiser(unet, levels.data_std, encoded)),
        observation_specs(observed, n_obs_steps, saved.weights),
        sample,
        action_dim,
        start,
        "teacher" if stop is None else "student",
        known,
        loop,
    )


def _levels(saved: Saved, scheduler: str, further: frozenset[str]) -> tuple[Levels, Settings]:
    """Of ``cfg.policy.noise_scheduler``, of which ``further`` are settings that only its training reads."""
    where = f"{saved.settings.where}noise_scheduler."
    settings = Settings(saved.policy["noise_scheduler"], where)
    found = str(settings.values.get("_target_")).rpartition(".")[2]
    if found != scheduler:
        raise CheckpointError(f"{where}_target_ is {found:.80}; expected {scheduler}. {_CHANGED}")
    read = {"_target_", "solver", "scaling", "bins", "use_c_in", "clamp", *_LEVELS, *_TRAINING, *further}
    if unknown := sorted(set(settings.values) - read):
        raise CheckpointError(f"{where[:-1]} has settings that are not known: {', '.join(unknown)}. {_CHANGED}")
    settings.require(use_c_in=True, clamp=True)  # both are always done
    numbers = {name: _positive(settings, name, settings.values.get(name)) for name in _LEVELS}
    if numbers["time_min"] >= numbers["time_max"]:
        raise settings.error(f"time_min is {numbers['time_min']}; expected less than time_max, {numbers['time_max']}")
    bins = settings.number("bins", most=MOST_STEPS + 1, least=1)
    if bins < 2:
        raise settings.refusal("bins", "2 at least")
    if settings.values.get("scaling") not in ("boundary", "no_boundary"):
        raise settings.refusal("scaling", "boundary or no_boundary")
    return Levels(**numbers, bins=bins, boundary=settings.values["scaling"] == "boundary"), settings


def _positive(settings: Settings, name: str, value: Any) -> float:
    if type(value) not in (int, float) or not 0 < value < float("inf"):
        raise settings.error(f"{name} is {settings.values.get(name)!r:.80}; expected positive numbers")
    return float(value)


def _chaining_times(settings: Settings, levels: Levels) -> Times:
    """After noise of which levels the student is evaluated again.

    After "C" stand bins. After "D" stand the times themselves: so the original's code has it, though its README calls
    them bins.
    """
    found = settings.values.get("chaining_times", ["D", 27, 54])
    if found in (None, "None"):
        return np.zeros(0)
    if not isinstance(found, list) or not found or found[0] not in ("C", "D") or len(found) > MOST_STEPS:
        raise settings.refusal("chaining_times", "C or D, and numbers after it, or null")
    numbers = [_positive(settings, "chaining_times", each) for each in found[1:]]
    return levels.times(numbers, levels.bins) if found[0] == "C" else np.array(numbers)


def edm_table(levels: Levels, steps: int, method: Method) -> SamplerTable:
    """The loop of a teacher; each evaluation is a row.

    The slope at a time is ``(x - x0) / t``. A memory is the sample of a later evaluation, or of the next step, as far
    as the slopes so far make it.
    """
    times, stages = levels.times(range(steps + 1), steps + 1), len(method.nodes)
    begin, end = times[:-1], times[1:]
    step, count = (end - begin).astype(np.float32).astype(np.float64), steps * stages
    at, sample_to_next, x0_to_next = np.zeros((3, count))
    memory_to_next, to_memory = np.zeros((count, stages - 1)), np.zeros((count, stages - 1, 2 + stages))
    for stage, node in enumerate(method.nodes):
        rows = np.arange(steps) * stages + stage
        at[rows] = end if node == 1 and not method.adds else (begin + node * step).astype(np.float32)
        share = step / at[rows]  # of a step along the slope
        own = share * method.weights[stage][stage]
        sample_to_next[rows], x0_to_next[rows] = own + (stage == 0), -own
        if stage:
            memory_to_next[rows, stage - 1] = 1
        for memory in range(stage, stages - 1):
            later = share * method.weights[memory + 1][stage]
            to_memory[rows, memory, 0], to_memory[rows, memory, 1] = -later, later
            to_memory[rows, memory, 3 + memory if stage else 1] += 1
    skip, out = levels.scalings(at)
    return deterministic_table(
        method.name,
        _told(at),
        1.0,
        sample_to_x0=skip,
        out_to_x0=out,
        x0_to_next=x0_to_next,
        sample_to_next=sample_to_next,
        memory_to_next=memory_to_next,
        to_memory=to_memory,
    )


def jump_table(levels: Levels, again: Times) -> SamplerTable:
    """The loop of a student: from time_max to the actions; and so again, from the actions with noise of each level."""
    times = np.array([levels.time_max, *again], np.float32).astype(np.float64)
    stays = levels.time_min / times
    skip, out = levels.scalings(times)
    return deterministic_table(
        "consistency",
        _told(times),
        1.0,
        sample_to_x0=stays + (1 - stays) * skip,
        out_to_x0=(1 - stays) * out,
        x0_to_next=np.ones(len(times)),
        noise_to_next=np.append(times[1:], 0.0),
    )
