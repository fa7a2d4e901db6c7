"""The diffusers scheduler that a configuration describes, and the same betas under another sampler.

How the K timesteps lie among those of training is a trap of its own (Lin et al., arXiv 2305.08891). Every loop starts
from pure noise. ``leading`` takes multiples of a whole stride counted from 0, so it starts *below* the last timestep,
where the network expects a sample that already has some of the action in it: DDIM-16 of 100 starts at t = 90,
DPM-Solver++-16 at t = 80, since diffusers counts a step more there. ``trailing`` and ``linspace`` start at the last
timestep. That is right, and has a trap too: with a cosine schedule and epsilon prediction the sample that is predicted
there is 2,000 times the network's error. A bound on it, as policies are trained with, makes that harmless; without it
DPM-Solver++-16 on Push-T leaves samples of 800 in place of 1. No two spacings of one sampler are told apart by their
scores, which ``docs/decisions.md`` has. So ``leading``, diffusers' own default, stays that of DDIM, and ``trailing`` is
that of DPM-Solver++ where the sample is bounded.
"""

import inspect
from collections.abc import Mapping
from typing import Any

from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler

from ..core.spec import SamplerTable
from ..errors import CheckpointError, SpecError, TtscompileError
from ..samplers.flow import METHODS
from ..samplers.table import NAMES, sampler_table
from .families import DIFFUSION_SAMPLERS, SPACINGS, LoadOptions
from .loops import Loops, loops_of
from .settings import Settings

MOST_TIMESTEPS = 10_000
"""Of the training; in use are 50 to 1000. diffusers computes each in Python."""
MOST_STEPS = 1000
"""Of a call; in use are 4 to 100. Each is evaluated with diffusers to make the table, which takes some milliseconds."""
DPM = "dpmsolver++"

_CLASSES: Mapping[str, type[Any]] = {
    NAMES[each.__name__]: each for each in (DDPMScheduler, DDIMScheduler, DPMSolverMultistepScheduler)
}
_SETTINGS = {name: frozenset(inspect.signature(each).parameters) for name, each in _CLASSES.items()}


def configured_loops(settings: Mapping[str, Any], own_steps: int | None, options: LoadOptions, **more: Any) -> Loops:
    """The denoising loop that a checkpoint's ``noise_scheduler`` describes, and the one that is asked for.

    The arguments and errors are those of ``configured_sampler``, and of ``loops_of``.
    """
    own = _own_class(settings)
    return loops_of(lambda each: configured_sampler(settings, own_steps, each, **more), options, own or "no scheduler")


def configured_sampler(
    settings: Mapping[str, Any],
    own_steps: int | None,
    options: LoadOptions,
    *,
    step_arguments: Mapping[str, Any] | None = None,
    where: str = "cfg.policy.noise_scheduler",
) -> SamplerTable:
    """The denoising loop that a checkpoint's ``noise_scheduler`` describes, or the one that is asked for in its place.

    Args:
        settings: of the scheduler, with its class in ``_target_``.
        own_steps: K of the policy; None for the number of training timesteps.
        step_arguments: what the policy hands to every ``step`` of its own scheduler (``eta``).
        where: the settings stand, for messages.
    """
    own, steps = _own_class(settings), own_steps if options.steps is None else options.steps
    _check_asked(options, steps)
    name, own_name = options.sampler or NAMES.get(own), NAMES.get(own)
    if name is None:
        raise CheckpointError(
            f"{where} is {own or 'of no class'}; expected one of {', '.join(NAMES)}. To run on its betas with"
            f" another sampler, give convert --sampler {' or '.join(DIFFUSION_SAMPLERS)}; then calibrate --learn"
            " loops,precision does what build would do."
        )
    given = _renamed(settings, where)
    unknown = sorted(set(given).difference(*_SETTINGS.values()))
    if unknown and name == own_name:
        told = f"{', '.join(unknown)}. Remove them from the configuration if they are not needed, and save it again"
        raise CheckpointError(f"{where} has settings that diffusers' {own} does not know: {told}.")
    if name != own_name:  # of diffusers, DDPM and DDIM have a bound where nothing is said, and nothing else has
        bounded = not own or own.startswith(("DDPM", "DDIM"))
        given["clip_sample"] = own_name != DPM and given.get("clip_sample", bounded)
        given = _for_dpm_solver(given, where) if name == DPM else given
    if options.spacing is not None:
        given["timestep_spacing"] = options.spacing
    trained = given.get("num_train_timesteps", 1000)
    if type(trained) is not int or not 1 <= trained <= MOST_TIMESTEPS:
        raise CheckpointError(f"{where}: num_train_timesteps is {trained!r:.80}; expected 1 to {MOST_TIMESTEPS}.")
    if steps is None and trained > MOST_STEPS:
        found = f"num_train_timesteps is {trained}, and a call would take as many steps; expected {MOST_STEPS} at most"
        raise CheckpointError(f"{where}: {found}. Give fewer: steps= in Python, --steps on the command line.")
    try:
        scheduler = _CLASSES[name](**{key: value for key, value in given.items() if key in _SETTINGS[name]})
        return sampler_table(
            scheduler,
            trained if steps is None else steps,
            step_arguments=_step_arguments(step_arguments or {}, given, own_name, name),
        )
    except TtscompileError:
        raise
    except Exception as error:  # settings of a wrong type fail wherever diffusers first uses them
        refused = f"{given!s:.300}: {type(error).__name__}: {error!s:.200}"
        raise CheckpointError(f"{where}: diffusers refuses the settings {refused}") from error


def _check_asked(options: LoadOptions, steps: int | None) -> None:
    """Raise SpecError unless there is such a sampler, such a spacing and such a number of steps."""
    sampler, spacing = options.sampler, options.spacing
    if sampler is not None and sampler not in DIFFUSION_SAMPLERS:
        raise SpecError(
            f"sampler {sampler!r} is none of a policy that was trained with diffusion; expected one of"
            f" {', '.join(DIFFUSION_SAMPLERS)}. {' and '.join(METHODS)} are for policies trained with flow matching."
        )
    if spacing is not None and spacing not in SPACINGS:
        raise SpecError(f"timestep spacing {spacing!r} is not known; expected one of {', '.join(SPACINGS)}.")
    if steps is not None and (type(steps) is not int or not 1 <= steps <= MOST_STEPS):
        raise SpecError(f"{steps!r:.80} denoising steps are not possible; expected a whole number, 1 to {MOST_STEPS}.")


def _renamed(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Settings by the names of today, without those that diffusers does not read: they begin with ``_``."""
    given = {key: value for key, value in settings.items() if not key.startswith("_")}
    old = given.pop("predict_epsilon", None)  # what diffusers before 0.11 called it
    if old is not None:
        predicts = "epsilon" if old else "sample"
        if given.setdefault("prediction_type", predicts) != predicts:
            found = f"prediction_type = {given['prediction_type']!r}"
            raise CheckpointError(f"{where}: predict_epsilon contradicts {found}.")
    return given


def _own_class(settings: Mapping[str, Any]) -> str:
    """Name of the scheduler's class, without its module; empty where there is none."""
    return str(settings.get("_target_", "")).rpartition(".")[2]


def _for_dpm_solver(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Settings of DPM-Solver++ for a network that was trained with another scheduler on these.

    DDPM and DDIM bound the predicted sample (``clip_sample``), DPM-Solver++ has no such setting. Its dynamic
    thresholding with a largest value of 1, the default, is the same bound. Configurations of DDPM and DDIM say nothing
    about the spacing of this solver.
    """
    thresholds, bound = settings.get("thresholding"), settings.get("clip_sample_range", 1.0)
    clips, most = thresholds or settings["clip_sample"], settings.get("sample_max_value", 1) if thresholds else 1
    if clips and bound != 1 and not thresholds:
        found = f"clip_sample_range is {bound!r:.80}"
        raise SpecError(f"{where}: {found}; sampler {DPM} bounds the sample at 1 or not at all. Use ddpm or ddim.")
    blows_up = not clips and settings.get("prediction_type", "epsilon") == "epsilon"
    changed = {"timestep_spacing": "leading" if blows_up else "trailing", "variance_type": None}
    return {**settings, **changed, "thresholding": bool(clips), "sample_max_value": most}


def _step_arguments(
    arguments: Mapping[str, Any], settings: Mapping[str, Any], own_name: str | None, name: str
) -> dict[str, Any]:
    """What of the policy's further settings goes to ``step``.

    ``predict_epsilon`` is what old versions called ``prediction_type``; it must agree. ``eta`` belongs to DDIM, and a
    sampler that was asked for in place of the policy's own is plain.
    """
    kept = dict(arguments)
    if "predict_epsilon" in kept:
        predicts = settings.get("prediction_type", "epsilon")
        if bool(kept.pop("predict_epsilon")) != (predicts == "epsilon"):
            found = f"noise_scheduler.prediction_type = {predicts!r}"
            raise CheckpointError(f"cfg.policy.predict_epsilon contradicts {found}.")
    unknown = sorted(set(kept) - {"eta", "use_clipped_model_output"})
    if unknown:
        raise CheckpointError(
            f"cfg.policy has settings that are not known: {', '.join(unknown)}. Where only the training reads them,"
            " remove them and save the checkpoint again; otherwise use ttscompile.compile_denoiser(module, spec)."
        )
    Settings(kept, "cfg.policy.").flag("use_clipped_model_output", False)
    if "eta" in kept and not isinstance(kept["eta"], (int, float)):
        raise CheckpointError(f"cfg.policy.eta is {kept['eta']!r}; expected a number.")
    return kept if name == own_name else {}
