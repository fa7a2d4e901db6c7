"""Models of several loops of one program, against those of programs that have one of them each."""

import numpy as np
import onnx
import pytest
import torch

from tests.lower.whole_call import Episode
from tests.passes.loops import models_of, module_of, program_of, spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import Noise
from ttscompile.errors import SpecError
from ttscompile.frontends.eager import eager_policy
from ttscompile.ir.pieces import is_of_loop, part_of
from ttscompile.lower.single_file import lower_single_file

pytestmark = pytest.mark.slow


def test_models_that_differ_between_loops_have_the_loops_name() -> None:
    """A loop that clips, draws and remembers as the original does, in as many steps, has none of its own."""
    further = {name for name in models_of() if is_of_loop(name)}
    assert set(models_of()) - further == set(models_of("original")) == set(models_of("ddim-3"))
    assert further == {
        "pruner@ddpm-4",
        "advance@ddim-3",  # it does not clip
        "pruner@ddim-3",
        "advance@dpmsolver++-4",  # it remembers
        "pruner@dpmsolver++-4",
    }
    assert {part_of(name) for name in further} == {None}


@pytest.mark.parametrize("loop", ["ddim-3", pytest.param("ddim-6-trailing", marks=pytest.mark.soak)])
def test_a_model_of_a_loop_is_that_of_its_own_program(loop: str) -> None:
    whole, alone = models_of(), models_of(loop)
    for piece in ("advance", "pruner"):
        found, expected = whole.get(f"{piece}@{loop}", whole[piece]), alone[piece]
        assert [node.SerializeToString() for node in found.graph.node] == [
            node.SerializeToString() for node in expected.graph.node
        ]
        for values in ("input", "output", "initializer"):
            mine, its = (
                [value.SerializeToString() for value in getattr(model.graph, values)] for model in (found, expected)
            )
            assert mine == its


@pytest.mark.parametrize("loop", ["original", "ddim-3"])
def test_a_single_file_is_of_one_loop(loop: str) -> None:
    """To the byte that of the program that has no other."""
    whole, alone = program_of("tokens"), program_of("tokens", loop)
    found = lower_single_file(whole, models_of(), whole.weights, loop)
    expected = lower_single_file(alone, models_of(loop), alone.weights)
    assert found.SerializeToString(deterministic=True) == expected.SerializeToString(deterministic=True)


@pytest.mark.parametrize("loop", ["ddpm-4", "dpmsolver++-4", "ddim-6-trailing"])
def test_a_single_file_computes_its_loop(loop: str) -> None:
    program, policy = program_of("tokens"), spec().in_loop(loop)
    model = lower_single_file(program, models_of(), program.weights, loop)
    onnx.checker.check_model(model, full_check=True)
    rng, steps = np.random.default_rng(0), policy.sampler.steps
    obs = rng.uniform(-1, 1, (2, 3, 7)).astype(np.float32)
    draws = rng.standard_normal((steps, 2, 4, 2), dtype=np.float32) if policy.sampler.stochastic else None
    noise = Noise(rng.standard_normal((2, 4, 2), dtype=np.float32), draws)
    with Counted() as counted:
        expected = eager_policy(module_of("tokens"), policy)({"obs": torch.from_numpy(obs)}, noise).numpy()
    dense = np.zeros((steps, len(program.blocks)), np.int8)
    found = Episode(model.SerializeToString(), 2).call({"obs": obs}, noise, dense)["action_pred"]
    gain = max(1.0, float(np.abs(policy.sampler.out_to_x0).max()))
    assert_equal_but_for_rounding(found / gain, expected / gain, counted.terms, counted.angle)


def test_a_single_file_of_a_loop_that_is_not_there() -> None:
    program = program_of("tokens")
    with pytest.raises(SpecError, match="loop 'ddim-4': expected one of original, ddpm-4"):
        lower_single_file(program, models_of(), program.weights, "ddim-4")
