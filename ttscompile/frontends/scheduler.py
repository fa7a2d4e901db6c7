"""The diffusers scheduler that a configuration describes, and the same betas under another sampler."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

from ..config import SamplerTable
from ..errors import CheckpointError, SpecError
from ..samplers import sampler_table

SPACINGS = ("leading", "trailing", "linspace")


def _scheduler_class(name: str) -> type[Any] | None:
    return {"ddpm": DDPMScheduler, "ddim": DDIMScheduler}.get(name)


def _settings(scheduler: type[Any]) -> frozenset[str]:
    """Names of the settings that a scheduler class takes."""
    return frozenset(inspect.signature(scheduler.__init__).parameters) - {"self"}


def configured_sampler(
    settings: Mapping[str, Any],
    steps: int | None,
    *,
    step_arguments: Mapping[str, Any],
    sampler: str | None = None,
    spacing: str | None = None,
) -> SamplerTable:
    """The denoising loop that a checkpoint's ``noise_scheduler`` describes.

    Args:
        settings: of the scheduler, with its class in ``_target_``.
        steps: K; None for the number of training timesteps.
        step_arguments: what the policy hands to every ``step`` of its own scheduler (``eta``).
        sampler: ``ddpm`` or ``ddim`` in place of the scheduler's own class, on the same betas.
        spacing: of the timesteps, in place of the configured one.

    Returns:
        The table.

    Raises:
        CheckpointError: the configured scheduler is of another class, or has settings that diffusers does not know.
        SpecError: the sampler, spacing or number of steps asked for is not possible.
    """
    own = str(settings.get("_target_", "")).rpartition(".")[2]
    own_name = own.removesuffix("Scheduler").lower()
    if sampler is not None and _scheduler_class(sampler) is None:
        raise SpecError(f"sampler {sampler!r} is not known; expected ddpm or ddim.")
    if spacing is not None and spacing not in SPACINGS:
        raise SpecError(f"timestep spacing {spacing!r} is not known; expected one of {', '.join(SPACINGS)}.")
    if steps is not None and (type(steps) is not int or steps < 1):
        raise SpecError(f"{steps!r} denoising steps are not possible; expected a positive whole number.")

    name = sampler or own_name
    scheduler_class = _scheduler_class(name)
    if scheduler_class is None:
        raise CheckpointError(
            f"cfg.policy.noise_scheduler is {own or 'of no class'}; expected DDPMScheduler or DDIMScheduler. To run on"
            " its betas with another sampler, ask for sampler='ddpm' or 'ddim'."
        )
    given = {key: value for key, value in settings.items() if key != "_target_"}
    unknown = sorted(set(given) - _settings(DDPMScheduler) - _settings(DDIMScheduler))
    if unknown and name == own_name:
        raise CheckpointError(
            f"cfg.policy.noise_scheduler has settings that diffusers' {own} does not know: {', '.join(unknown)}."
            " Remove them from the configuration if they are not needed, and save the checkpoint again."
        )
    if spacing is not None:
        given["timestep_spacing"] = spacing
    taken = _settings(scheduler_class)
    try:
        scheduler = scheduler_class(**{key: value for key, value in given.items() if key in taken})
    except (TypeError, ValueError, NotImplementedError) as error:
        raise CheckpointError(f"cfg.policy.noise_scheduler: diffusers refuses the settings {given}: {error}") from error
    return sampler_table(
        scheduler,
        int(scheduler.config.num_train_timesteps) if steps is None else steps,
        name=name,
        step_arguments=_step_arguments(step_arguments, given, own_name, name),
    )


def _step_arguments(
    arguments: Mapping[str, Any], settings: Mapping[str, Any], own_name: str, name: str
) -> dict[str, Any]:
    """What of the policy's further settings goes to ``step``.

    ``predict_epsilon`` is what old versions called ``prediction_type``; it must agree. ``eta`` belongs to DDIM, and a
    sampler that was asked for in place of the policy's own is plain.
    """
    kept = dict(arguments)
    if "predict_epsilon" in kept:
        predicts = settings.get("prediction_type", "epsilon")
        if bool(kept.pop("predict_epsilon")) != (predicts == "epsilon"):
            raise CheckpointError(
                f"cfg.policy.predict_epsilon contradicts noise_scheduler.prediction_type = {predicts!r}."
            )
    unknown = sorted(set(kept) - {"eta", "use_clipped_model_output"})
    if unknown:
        raise CheckpointError(f"cfg.policy has settings that are not known: {', '.join(unknown)}.")
    if "use_clipped_model_output" in kept and type(kept["use_clipped_model_output"]) is not bool:
        raise CheckpointError("cfg.policy.use_clipped_model_output must be true or false.")
    if "eta" in kept and not isinstance(kept["eta"], (int, float)):
        raise CheckpointError(f"cfg.policy.eta is {kept['eta']!r}; expected a number.")
    return kept if name == own_name else {}
