"""Checkpoints under DPM-Solver++ against diffusers' own loop around the network as it was trained."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler

import ttscompile
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import Noise
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.samplers.table import set_timesteps

Build = Callable[..., dict[str, Any]]
Save = Callable[[dict[str, Any]], Path]

BETAS: dict[str, Any] = {"num_train_timesteps": 20, "beta_schedule": "squaredcos_cap_v2"}
SOLVER = "diffusers.schedulers.scheduling_dpmsolver_multistep.DPMSolverMultistepScheduler"


@pytest.mark.parametrize(
    ("own", "arguments", "settings", "steps"),
    [
        ({}, {"sampler": "dpmsolver++", "steps": 8}, {"thresholding": True, "timestep_spacing": "trailing"}, 8),
        (
            {"_target_": SOLVER, "prediction_type": "sample", "timestep_spacing": "trailing"},
            {"steps": 5},
            {"prediction_type": "sample", "timestep_spacing": "trailing"},
            5,
        ),
    ],
)
def test_it_gives_what_diffusers_gives(
    payload: Build, save: Save, own: dict[str, Any], arguments: Any, settings: dict[str, Any], steps: int
) -> None:
    """A policy of DDPM, with the bound on the sample that it was trained with; and one of RDT-1B's scheduler."""
    built = payload()
    scheduler_config = built["cfg"]["policy"]["noise_scheduler"]
    if own:
        for name in ("variance_type", "clip_sample"):
            del scheduler_config[name]
    scheduler_config |= own
    path = save(built)
    module, whole = load_checkpoint_policy(path, options=LoadOptions(**arguments))
    assert list(whole.loops) == [f"dpmsolver++-{steps}"]
    assert whole.sampler.same_as(load_checkpoint_policy(path)[1].sampler)
    spec = whole.in_loop(f"dpmsolver++-{steps}")
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
        loops = load_checkpoint_policy(save(payload_with(built, changes)), options=options)[1].loops
        table = loops["dpmsolver++-4"]
        assert (table.clip, table.timesteps[0]) == (bound, first)
    scheduler |= {"clip_sample": True, "clip_sample_range": 2.0}
    with pytest.raises(SpecError, match="clip_sample_range is 2.0; sampler dpmsolver"):
        load_checkpoint_policy(save(built), options=LoadOptions(sampler="dpmsolver++", steps=8))
    spec = load_checkpoint_policy(save(built), options=LoadOptions(sampler="ddim", steps=8))[1]
    assert (spec.sampler.clip, spec.loops["ddim-8"].clip) == (2, 2)
    scheduler["thresholding"] = True  # which diffusers has instead
    for sampler in ("ddim", "dpmsolver++"):
        spec = load_checkpoint_policy(save(built), options=LoadOptions(sampler=sampler, steps=8))[1]
        assert (spec.sampler.clip, spec.loops[f"{sampler}-8"].clip) == (1, 1)
        scheduler["sample_max_value"] = 2.0
        with pytest.raises(SpecError, match="thresholding=True depends on the whole sample"):
            load_checkpoint_policy(save(built), options=LoadOptions(sampler=sampler, steps=8))
        scheduler["sample_max_value"] = 1.0


@pytest.mark.parametrize(
    ("changes", "bound"), [({}, None), ({"sample_max_value": 2.0}, None), ({"thresholding": True}, 1.0)]
)
@pytest.mark.parametrize("sampler", ["ddim", "ddpm"])
def test_a_policy_of_the_solver_gets_no_bound_that_it_had_not(
    payload: Build, save: Save, changes: dict[str, Any], bound: float | None, sampler: str
) -> None:
    """The settings of the solver have no ``clip_sample``, which DDPM and DDIM have on where nothing is said."""
    built = payload()
    own = BETAS | {"_target_": SOLVER, "prediction_type": "sample"} | changes
    built["cfg"]["policy"] |= {"noise_scheduler": own, "num_inference_steps": 4}
    spec = load_checkpoint_policy(save(built), options=LoadOptions(sampler=sampler, steps=5))[1]
    assert (spec.sampler.clip, spec.loops[f"{sampler}-5"].clip) == (bound, bound)
    own |= {"thresholding": True, "sample_max_value": 1.5}
    with pytest.raises(SpecError, match="thresholding=True depends on the whole sample"):
        load_checkpoint_policy(save(built), options=LoadOptions(sampler=sampler, steps=5))


@pytest.mark.parametrize("own", ["UniPCMultistepScheduler", "DEISMultistepScheduler", "EulerDiscreteScheduler"])
@pytest.mark.parametrize(("sampler", "first"), [("ddim", 15), ("dpmsolver++", 16)])
def test_nor_does_one_of_another_solver(payload: Build, save: Save, own: str, sampler: str, first: int) -> None:
    """Those of diffusers leave the predicted sample as it is, but for thresholding."""
    built = payload()
    scheduler = built["cfg"]["policy"]["noise_scheduler"] = BETAS | {"_target_": f"diffusers.{own}"}
    for changes, bound, at in (({}, None, first), ({"thresholding": True}, 1, {"ddim": 15}.get(sampler, 19))):
        path = save(payload_with(built, changes))
        table = load_checkpoint_policy(path, options=LoadOptions(sampler=sampler, steps=4))[1].sampler
        assert (table.clip, table.timesteps[0]) == (bound, at)
    scheduler["sample_max_value"] = 1.5
    with pytest.raises(SpecError, match="thresholding=True depends on the whole sample"):
        load_checkpoint_policy(save(built), options=LoadOptions(sampler=sampler, steps=4))


def payload_with(built: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The checkpoint with other settings of its scheduler."""
    built["cfg"]["policy"]["noise_scheduler"].update(changes)
    return built


def test_spacings_of_the_solver(payload: Build, save: Save) -> None:
    """Its own default is used for a policy of DDPM, whose configuration says nothing about it; or what is asked for."""
    built = payload()
    built["cfg"]["policy"]["noise_scheduler"]["timestep_spacing"] = "leading"  # of DDPM, that is trained on all of them
    path, options = save(built), LoadOptions(sampler="dpmsolver++", steps=4)
    found: dict[str, list[int]] = {}
    for spacing in (None, "leading", "trailing", "linspace"):
        spec = load_checkpoint_policy(path, options=replace(options, spacing=spacing))[1]
        assert spec.sampler.timesteps.tolist() == list(range(19, -1, -1))
        found |= {name: table.timesteps.tolist() for name, table in spec.loops.items()}
    assert found == {
        "dpmsolver++-4": [19, 14, 9, 4],
        "dpmsolver++-4-leading": [16, 12, 8, 4],
        "dpmsolver++-4-trailing": [19, 14, 9, 4],
        "dpmsolver++-4-linspace": [19, 14, 10, 5],
    }
    with pytest.raises(SpecError, match="'leading' timestep spacing gives 20 steps only 1 different noise level"):
        load_checkpoint_policy(path, options=LoadOptions(sampler="dpmsolver++", steps=20, spacing="leading"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({}, []),
        ({"steps": 20}, []),
        ({"sampler": "ddpm"}, []),
        ({"sampler": "ddpm", "steps": 20, "spacing": "leading"}, []),  # which is diffusers' default
        ({"steps": 19}, ["ddpm-19"]),
        ({"sampler": "ddim"}, ["ddim-20"]),
        ({"spacing": "trailing"}, []),  # all of the timesteps, whatever the spacing
        ({"steps": 5, "spacing": "trailing"}, ["ddpm-5-trailing"]),
        ({"sampler": "dpmsolver++", "steps": 16}, ["dpmsolver++-16"]),
    ],
)
def test_the_loop_that_is_asked_for_stands_beside_the_policys_own(
    payload: Build, save: Save, options: dict[str, Any], names: list[str]
) -> None:
    """It has a name that says what it is, unless it is the original's."""
    path = save(payload())
    original, spec = (load_checkpoint_policy(path, options=each)[1] for each in (LoadOptions(), LoadOptions(**options)))
    assert list(spec.loops) == names
    assert (spec.sampler.name, spec.sampler.steps) == ("ddpm", 20)
    assert spec.sampler.same_as(original.sampler) and spec.source == original.source
    for name, table in spec.loops.items():
        assert not table.same_as(spec.sampler) and name.startswith(f"{table.name}-{table.steps}")


def test_eta_is_of_the_original_loop(payload: Build, save: Save) -> None:
    """DDIM of 20 steps with noise is not DDIM of 20 steps without."""
    built = payload()
    built["cfg"]["policy"]["eta"] = 0.5
    built["cfg"]["policy"]["noise_scheduler"]["_target_"] = "diffusers.DDIMScheduler"
    path = save(built)
    fewer = load_checkpoint_policy(path, options=LoadOptions(steps=4))[1]
    assert fewer.sampler.stochastic and fewer.loops["ddim-4"].stochastic
    other = load_checkpoint_policy(path, options=LoadOptions(sampler="ddpm"))[1]
    assert other.sampler.stochastic and not other.loops["ddpm-20"].out_to_next.any()


@pytest.mark.parametrize(
    ("scheduler", "own"),
    [
        ({"_target_": "diffusers.PNDMScheduler"}, "PNDMScheduler"),
        ({"_target_": ""}, "no scheduler"),
        ({"skip_prk_steps": True}, "DDPMScheduler"),  # which does not know that setting
        ({"num_train_timesteps": 4000}, "DDPMScheduler"),  # more than a call may have
    ],
)
def test_where_the_own_loop_has_no_table_the_one_asked_for_is_the_original(
    payload: Build, save: Save, scheduler: dict[str, Any], own: str
) -> None:
    """The source says so; and without anything asked for there is no policy."""
    built = payload()
    built["cfg"]["policy"]["num_inference_steps"] = None
    path = save(payload_with(built, scheduler))
    spec = load_checkpoint_policy(path, options=LoadOptions(sampler="ddim", steps=4))[1]
    assert (spec.sampler.name, spec.sampler.steps, dict(spec.loops)) == ("ddim", 4, {})
    assert spec.source["sampler"] == f"ddim-4 in place of {own}"
    with pytest.raises(CheckpointError, match="noise_scheduler"):
        load_checkpoint_policy(path)
    with pytest.raises(SpecError, match="'even' is not known"):
        load_checkpoint_policy(path, options=LoadOptions(spacing="even"))


@pytest.mark.slow
def test_converting_keeps_the_original_beside_the_loop_that_is_asked_for(
    payload: Build, save: Save, tmp_path: Path
) -> None:
    """The program has both; the single file is of the one asked for."""
    told: dict[str, tuple[str, ...]] = {}
    program = ttscompile.convert(
        save(payload()),
        tmp_path / "compiled",
        sampler="ddim",
        steps=4,
        single_file=tmp_path / "policy.onnx",
        explain=told.__setitem__,
    )
    assert {name: one.steps for name, one in program.spec.all_loops.items()} == {"original": 20, "ddim-4": 4}
    assert told["record_original"] == ("20 of 20 steps, 2 streams", "ddim-4: 4 of 4")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    shapes = {value.name: value.shape for value in session.get_inputs()}
    assert shapes["plan"] == ["P", 4, len(program.blocks)] and "step_noise" not in shapes
    assert ttscompile.verify(tmp_path / "compiled").passed
