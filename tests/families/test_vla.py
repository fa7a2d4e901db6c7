"""Action heads of vision-language-action models against outputs of the originals; see ``golden/README.md``."""

from pathlib import Path

import pytest
import torch

import ttscompile
from tests.families.checks import assert_runtimes_agree, in_loop, kinds, rounded
from tests.families.heads import FAMILIES, Family, loaded
from tests.families.support import record
from tests.quick import first_quick
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.driver import transform
from ttscompile.ir.program import Program

LOWERED = ("smolvla",)
"""Run through both runtimes every time; the others with ``-m soak``, for the sake of time."""


def assert_found(family: Family, program: Program) -> None:
    assert kinds(program) == family.blocks
    assert all(block.residual is not None for block in program.blocks)
    assert in_loop(program) < family.loop
    sampler = program.spec.sampler
    record(family.title, family.verified, f"{sampler.name} {sampler.steps}", program)


@pytest.mark.parametrize("name", FAMILIES)
def test_a_head_computes_what_the_original_computes(name: str) -> None:
    family = FAMILIES[name]()
    module, arrays, _ = loaded(family, name)
    inputs = {key: torch.from_numpy(arrays[key]) for key in family.conditions}
    with torch.no_grad(), Counted() as counted:
        timesteps = torch.from_numpy(arrays["timesteps"]) / family.scale
        made = module(torch.from_numpy(arrays["noise"]), timesteps, **inputs)
    assert_equal_but_for_rounding(made, arrays[family.prediction], counted.terms, counted.angle)


@pytest.mark.slow
@pytest.mark.parametrize("name", first_quick(name for name in FAMILIES if name not in LOWERED))
def test_its_blocks_are_found(name: str) -> None:
    family = FAMILIES[name]()
    module, _, spec = loaded(family, name)
    assert_found(family, transform(module, spec))


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in LOWERED else pytest.mark.soak) for n in FAMILIES])
def test_a_compiled_head_acts_as_the_original(name: str, tmp_path: Path) -> None:
    family = FAMILIES[name]()
    module, arrays, spec = loaded(family, name)
    conditions = {key: arrays[key] for key in family.conditions}
    assert_found(family, ttscompile.compile_denoiser(module, spec, tmp_path / "compiled"))
    terms, angle = rounded(module, conditions, spec)
    for runtime in ("reference", "onnxruntime"):
        policy = ttscompile.load(tmp_path / "compiled", runtime=runtime)
        noise = ttscompile.Noise(arrays["noise"])
        action = policy.predict_action(conditions, noise=noise, plan="dense")["action"]
        assert_equal_but_for_rounding(action, arrays["actions"], terms, angle)
    assert_runtimes_agree(tmp_path / "compiled")
