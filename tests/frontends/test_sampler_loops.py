"""Checkpoints under DPM-Solver++ against diffusers' own loop around the network as it was trained."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler

from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import Noise
from ttscompile.errors import SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.samplers.multistep import set_timesteps

Build = Callable[..., dict[str, Any]]
Save = Callable[[dict[str, Any]], Path]

BETAS: dict[str, Any] = {"num_train_timesteps": 20, "beta_schedule": "squaredcos_cap_v2"}
SOLVER = "diffusers.schedulers.scheduling_dpmsolver_multistep.DPMSolverMultistepScheduler"


@pytest.mark.parametrize(
    ("own", "arguments", "settings", "steps"),
    [
        ({}, {"sampler": "dpmsolver++", "steps": 8}, {"thresholding": True, "timestep_spacing": "trailing"}, 8),
        ({"_target_": SOLVER, "prediction_type": "sample"}, {"steps": 5}, {"prediction_type": "sample"}, 5),
    ],
)
def test_it_gives_what_diffusers_gives(
    payload: Build,
    save: Save,
    own: dict[str, Any],
    arguments: Any,
    settings: dict[str, Any],
    steps: int,
) -> None:
    """A policy of DDPM, with the bound on the sample that it was trained with; and one of RDT-1B's scheduler."""
    built = payload()
    scheduler_config = built["cfg"]["policy"]["noise_scheduler"]
    if own:
        for name in ("variance_type", "clip_sample"):
            del scheduler_config[name]
    scheduler_config |= own
    module, spec = load_checkpoint_policy(save(built), options=LoadOptions(**arguments))
    assert (spec.sampler.name, spec.sampler.steps, spec.sampler.memories) == ("dpmsolver++", steps, 1)
    draw = np.random.default_rng(0)
    obs = {key: draw.standard_normal((2, *one.shape)).astype(np.float32) for key, one in spec.observations.items()}
    noise = Noise(draw.standard_normal((2, *spec.sample)).astype(np.float32))
    tensors = {key: torch.from_numpy(value) for key, value in obs.items()}

    scheduler = DPMSolverMultistepScheduler(**(BETAS | settings))
    set_timesteps(scheduler, steps)
    x = torch.from_numpy(noise.initial)
    with torch.no_grad(), Counted() as counted:
        for timestep in scheduler.timesteps:
            x = scheduler.step(module(x, timestep.expand(2), **tensors), timestep, x).prev_sample
    expected = x.numpy()
    assert np.abs(expected).max() < 20  # of a random network, but no overflow
    found = eager_policy(module, spec)(tensors, noise)
    assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


def test_the_bound_on_the_sample_is_kept_or_refused(payload: Build, save: Save) -> None:
    """DDPM's ``clip_sample`` has no counterpart among the solver's settings but dynamic thresholding at 1."""
    built = payload()
    scheduler = built["cfg"]["policy"]["noise_scheduler"]
    for changes, bound, first in (
        ({}, 1.0, 19),
        ({"clip_sample": False}, None, 16),  # without a bound the last timestep would blow the sample up
        ({"prediction_type": "sample"}, None, 19),  # unless the network predicts it itself
    ):
        options = LoadOptions(sampler="dpmsolver++", steps=4)
        table = load_checkpoint_policy(save(payload_with(built, changes)), options=options)[1].sampler
        assert (table.clip, table.timesteps[0]) == (bound, first)
    scheduler |= {"clip_sample": True, "clip_sample_range": 2.0}
    with pytest.raises(SpecError, match="clip_sample_range is 2.0; sampler dpmsolver"):
        load_checkpoint_policy(save(built), options=LoadOptions(sampler="dpmsolver++", steps=8))
    assert load_checkpoint_policy(save(built), options=LoadOptions(sampler="ddim", steps=8))[1].sampler.clip == 2


def payload_with(built: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The checkpoint with other settings of its scheduler."""
    built["cfg"]["policy"]["noise_scheduler"].update(changes)
    return built


def test_spacings_of_the_solver(payload: Build, save: Save) -> None:
    """Its own default is used for a policy of DDPM, whose configuration says nothing about it; or what is asked for."""
    built = payload()
    built["cfg"]["policy"]["noise_scheduler"]["timestep_spacing"] = "leading"  # of DDPM, that is trained on all of them
    path, options = save(built), LoadOptions(sampler="dpmsolver++", steps=4)
    found = {
        spacing: load_checkpoint_policy(path, options=replace(options, spacing=spacing))[1].sampler.timesteps
        for spacing in (None, "leading", "trailing", "linspace")
    }
    assert {spacing: one.tolist() for spacing, one in found.items()} == {
        None: [19, 14, 9, 4],
        "leading": [16, 12, 8, 4],
        "trailing": [19, 14, 9, 4],
        "linspace": [19, 14, 10, 5],
    }
    with pytest.raises(SpecError, match="'leading' timestep spacing gives 20 steps only 1 different noise level"):
        load_checkpoint_policy(path, options=LoadOptions(sampler="dpmsolver++", steps=20, spacing="leading"))
