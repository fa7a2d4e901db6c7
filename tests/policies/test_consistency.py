"""Consistency Policy: what the original gave; see ``golden/make_consistency_policy.py``."""

import copy
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families.checks import part
from tests.rounding import PROMISED, assert_equal_but_for_rounding
from ttscompile.core.spec import Noise, PolicySpec, SamplerTable
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED, LoadOptions
from ttscompile.ir.program import Program
from ttscompile.policies.diffusion_policy import family as diffusion_policy

from ..families.support import record
from . import consistency
from .originals import Arrays, as_seen, assert_actions, assert_same_actions, golden

Build = Callable[..., tuple[Any, PolicySpec]]
_weights = cache(consistency.state_dict)
COMPARED = "actions that the original gave, 1e-5 of the range"


@pytest.fixture
def build() -> Build:
    """Build a policy with changes to ``cfg.policy`` and to its scheduler, without a file."""

    def run(
        variant: str, options: LoadOptions = AS_SAVED, scheduler: dict[str, Any] | None = None, **policy: Any
    ) -> tuple[Any, PolicySpec]:
        config = copy.deepcopy(consistency.configuration(variant))
        config["policy"].update(policy)
        if scheduler:
            config["policy"]["noise_scheduler"].update(scheduler)
        state = _weights("student" if consistency.is_student(variant) else "euler")
        return diffusion_policy.build({"cfg": config, "state_dicts": {"model": state, "ema_model": state}}, options)

    return run


def expected(variant: str) -> Arrays:
    """What the original gave of one variant."""
    return part(golden("consistency_policy"), variant)


def asked(spec: PolicySpec) -> SamplerTable:
    """The loop that was asked for, or that of the checkpoint."""
    return next(iter(spec.loops.values()), spec.sampler)


def noise(table: SamplerTable) -> Noise:
    """That which the original was given."""
    return Noise(*consistency.noise(table.steps)) if table.stochastic else Noise(consistency.noise(1)[0])


@pytest.mark.slow
@pytest.mark.parametrize("variant", consistency.VARIANTS)
def test_the_original_gave_the_same(variant: str) -> None:
    """The times that its network is told, what that gives at first, and the actions of a whole call."""
    numbers = expected(variant)
    count = len(numbers["told"])
    options = LoadOptions(steps=count) if consistency.is_student(variant) else AS_SAVED
    module, spec = diffusion_policy.build(consistency.payload(variant), options)
    assert spec.source["weights"] == ("model" if consistency.is_student(variant) else "ema_model")
    table = asked(spec)
    # Logarithms of noise levels, which processors round otherwise: one function and a product.
    assert_equal_but_for_rounding(table.timesteps, numbers["told"], terms=17)
    observation, given = as_seen(spec, consistency.observation()), noise(table)
    with torch.inference_mode():
        first = module(torch.from_numpy(given.initial), torch.from_numpy(table.timesteps[:1]).expand(2), **observation)
    assert np.abs(first.numpy() - numbers["first_out"]).max() < PROMISED * np.ptp(numbers["first_out"])
    changed = PolicySpec(spec.sample, spec.observations, table, spec.chunk)
    assert_actions(spec, eager_policy(module, changed)(observation, given), numbers)


# Compiled


def convert(variant: str, folder: Path, **options: Any) -> Program:
    """From a file, as the command does."""
    torch.save(consistency.payload(variant), folder / "policy.ckpt")
    return ttscompile.convert(folder / "policy.ckpt", folder / "compiled", **options)


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_the_compiled_teacher_is_the_original(teacher: tuple[Program, Path], runtime: str) -> None:
    """Heun's method, two evaluations a step, from raw observations to actions."""
    policy = ttscompile.load(teacher[1], runtime=runtime)
    found = policy.predict_action(consistency.observation(), noise=noise(teacher[0].spec.sampler))
    assert_same_actions(found, expected("heun"))


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
@pytest.mark.parametrize(("plan", "variant"), [("dense", "student"), ("full", "student_chained")])
def test_the_compiled_student_is_the_original(
    student: tuple[Program, Path], runtime: str, plan: str, variant: str
) -> None:
    """In one evaluation, and in three with noise between."""
    program, directory = student
    table = program.spec.sampler if plan == "dense" else asked(program.spec)
    policy = ttscompile.load(directory, runtime=runtime)
    found = policy.predict_action(consistency.observation(), noise=noise(table), plan=plan)
    assert_same_actions(found, expected(variant))


@pytest.mark.slow
def test_what_is_said_of_them(teacher: tuple[Program, Path], student: tuple[Program, Path]) -> None:
    """Their rows of the support table."""
    record("Consistency Policy, teacher", COMPARED, "edm-heun 14", teacher[0])
    family = "Consistency Policy, student (one evaluation or three: it gains eight bits, known frames, no torch)"
    record(family, COMPARED, "consistency 1", student[0])


@pytest.fixture(scope="module")
def teacher(tmp_path_factory: pytest.TempPathFactory) -> tuple[Program, Path]:
    """Program and artifact of a teacher."""
    folder = tmp_path_factory.mktemp("teacher")
    return convert("heun", folder), folder / "compiled"


@pytest.fixture(scope="module")
def student(tmp_path_factory: pytest.TempPathFactory) -> tuple[Program, Path]:
    """Program and artifact of a student, with the loop of three evaluations too."""
    folder = tmp_path_factory.mktemp("student")
    return convert("student", folder, steps=3), folder / "compiled"


# Settings


@pytest.mark.slow
def test_another_method_in_its_place(build: Build) -> None:
    """Euler, and the fourth order, of as many steps as the bins leave, or of fewer."""
    own = build("heun")[1].sampler
    for sampler, steps, name in (("euler", None, "edm-euler-7"), ("euler", 3, "edm-euler-3"), ("rk4", 3, "edm-rk4-12")):
        spec = build("heun", LoadOptions(sampler=sampler, steps=steps))[1]
        solver = {"solver": {"rk4": "fourth"}.get(sampler, sampler), "bins": (steps or 7) + 1}
        assert spec.sampler.same_as(own)
        assert spec.loops[name].same_as(build("heun", scheduler=solver)[1].sampler)
    assert own.steps == 14 and own.bound is None
    assert not build("heun", LoadOptions(steps=7))[1].loops


def test_loops_that_there_are_beside(build: Build) -> None:
    """Of those that a calibration may choose from; a student has none."""
    options = LoadOptions(loops=[("euler", 5), ("ddim", 5), ("rk4", 3), ("rk4", 4)])
    assert list(build("heun", options)[1].loops) == ["edm-euler-5", "edm-rk4-12"]
    assert not build("student", options)[1].loops


def test_a_student_knows_its_loop_by_its_length(build: Build) -> None:
    """Once as it is saved; the noise between is that of the next time, and the last step gives the actions."""
    spec = build("student")[1]
    assert (spec.sampler.steps, spec.sampler.stochastic, spec.sampler.bound, spec.loops) == (1, False, 1.0, {})
    chained = build("student", LoadOptions(steps=3))[1].loops["consistency-3"]
    assert chained.noise_to_next.tolist() == [27, 54, 0] and chained.bound == 1
    bins = build("student_chained_bins", LoadOptions(steps=4))[1].loops["consistency-4"]
    assert (np.diff(bins.timesteps) < 0).all()
    for none in (None, "None", ["D"]):
        with pytest.raises(SpecError, match="expected 1: .*of which there are 0"):
            build("student", LoadOptions(steps=2), chaining_times=none)


@pytest.mark.parametrize(
    ("variant", "options", "message"),
    [
        ("heun", {"sampler": "ddim"}, r"'ddim' is none of a teacher .*; expected euler or rk4, or none for its own"),
        ("heun", {"steps": 10**6}, "1000000 denoising steps are not possible; expected 1000 at most"),
        ("heun", {"spacing": "leading"}, "spacing is for diffusers' schedulers"),
        ("student", {"sampler": "euler"}, "'euler' is none of a student .*leave it out"),
        ("student", {"steps": 2}, "2 evaluations are not possible; expected 1 or 3: .*of which there are 2"),
        ("student", {"spacing": "leading"}, "spacing is for diffusers' schedulers"),
    ],
)
def test_options_that_do_not_fit(build: Build, variant: str, options: dict[str, Any], message: str) -> None:
    """Each is named, with what was expected."""
    with pytest.raises(SpecError, match=message):
        build(variant, LoadOptions(**options))


@pytest.mark.parametrize(
    ("variant", "given", "message"),
    [
        ("heun", {"scheduler": {"solver": "second_order_corr"}}, "expected euler or .*; second_order_corr draws a"),
        ("heun", {"scheduler": {"solver": ["heun"]}}, r"noise_scheduler\.solver is \['heun'\]"),
        ("heun", {"scheduler": {"_target_": "a.PFGMPP_Scheduler"}}, "is PFGMPP_Scheduler; expected Karras_Scheduler"),
        ("heun", {"scheduler": {"D": 128}}, r"noise_scheduler has settings that are not known: D\."),
        ("heun", {"scheduler": {"use_c_in": False}}, "use_c_in is False; expected true"),
        ("heun", {"scheduler": {"scaling": "none"}}, "scaling is 'none'; expected boundary or no_boundary"),
        ("heun", {"scheduler": {"time_min": 80}}, r"time_min is 80\.0; expected less than time_max, 80\.0"),
        ("heun", {"scheduler": {"data_std": "0.5"}}, "data_std is '0.5'; expected positive numbers"),
        ("heun", {"scheduler": {"rho": float("nan")}}, "rho is nan; expected positive numbers"),
        ("heun", {"scheduler": {"bins": 1}}, "bins is 1; expected 2 at least"),
        ("heun", {"scheduler": {"bins": 10**6}}, "bins is 1000000; expected .* 1001 at most"),
        ("heun", {"obs_as_global_cond": False}, "obs_as_global_cond is false; expected true: the original puts"),
        ("heun", {"chaining_times": ["D", 27]}, "settings that Consistency Policy does not know: chaining_times"),
        ("heun", {"down_dims": [16, 32]}, r"model\.\S+ has shape \(24,.*; expected \(32,"),
        ("heun", {"diffusion_step_embed_dim": "16"}, "diffusion_step_embed_dim is '16'; expected a positive whole"),
        ("heun", {"_target_": "a.CTMPPUnetHybridImagePolicy"}, "is Karras_Scheduler; expected CTM_Scheduler"),
        ("heun", {"noise_scheduler": None}, "noise_scheduler is missing; expected the settings of a scheduler"),
        ("student", {"chaining_times": ["E", 27]}, r"chaining_times is \['E', 27\]; expected C or D, and numbers"),
        ("student", {"chaining_times": ["D", -1]}, r"chaining_times is \['D', -1\]; expected positive numbers"),
        ("student", {"use_kde": True}, "use_kde is true: the original draws kde_samples"),
        ("student", {"diffusion_step_embed_dim": 8}, r"model\.\S+ has shape \(64,.*; expected \(32,"),
    ],
)
def test_settings_that_do_not_fit(build: Build, variant: str, given: dict[str, Any], message: str) -> None:
    """Each is named, with what was expected."""
    with pytest.raises(CheckpointError, match=message):
        build(variant, **given)
