"""``prediction_horizon``: fewer steps are predicted, and they are the original's."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import ttscompile
from tests.families.heads import FAMILIES, loaded
from tests.policies.variants import VARIANTS, Build, Save
from tests.rounding import Counted, assert_equal_but_for_rounding, bound
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.typed_json import to_json
from ttscompile.capture.narrow import narrow, unneeded
from ttscompile.cli import main
from ttscompile.errors import ObservationError, SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.verification import verify

KEPT, HORIZON, STREAMS = 4, 6, 2


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "as_cond", "model"), VARIANTS)
def test_steps_can_be_left_out_of_causal_networks_only(
    payload: Build, save: Save, variant: str, as_cond: bool, model: dict[str, Any]
) -> None:
    module, spec = load_checkpoint_policy(save(payload(as_cond, **model)))
    if model.get("causal_attn", True):
        with Counted() as counted:
            narrowed, difference = narrow(module, spec, KEPT)
        assert difference < 5 * bound(counted.terms, counted.angle)  # of the deviation; the largest number is no five
        assert (narrowed.sample, narrowed.left_out) == ((KEPT, spec.sample[1]), HORIZON - KEPT)
        assert narrowed.whole_horizon == spec
        assert "of 6 predicted steps 1 to 3 are executed" in (unneeded(module, spec) or "")
    else:
        with pytest.raises(SpecError, match=r"is 4, but these steps depend on the 2 after them: .*predict all 6"):
            narrow(module, spec, KEPT)
        assert unneeded(module, spec) is None
    executed = replace(spec, sample=(KEPT, spec.sample[1]))
    assert unneeded(module, executed) is None


@pytest.mark.parametrize("steps", [3, 7])
def test_no_fewer_than_are_executed_and_no_more_than_there_are(payload: Build, save: Save, steps: int) -> None:
    module, spec = load_checkpoint_policy(save(payload()))
    with pytest.raises(SpecError, match=rf"is {steps}; expected at least 4, .* actions 1 to 3, and at most 6"):
        narrow(module, spec, steps)


def test_a_network_of_one_length(payload: Build, save: Save) -> None:
    module, spec = load_checkpoint_policy(save(payload()))

    class OneLength(torch.nn.Module):
        def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
            return module(sample.reshape(-1, HORIZON, 3), timestep, obs)

    with pytest.raises(SpecError, match=r"does not take a sample of 4 steps: .*predict all 6 steps"):
        narrow(OneLength(), spec, KEPT)


def _pads(y: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.pad(y, (0, 0, 0, HORIZON - y.shape[1]))


@pytest.mark.parametrize(
    ("then", "message"),
    [
        (lambda y: y * (float("nan") if y.shape[1] < HORIZON else 1), "differs by nan"),
        (_pads, "does not take a sample of 4 steps"),
        (lambda y: y[{HORIZON: slice(None)}[y.shape[1]]], "does not take a sample of 4 steps"),
    ],
)
def test_no_number_another_shape_or_any_error_of_the_module_is_refused(
    payload: Build, save: Save, then: Callable[[torch.Tensor], torch.Tensor], message: str
) -> None:
    _, spec = load_checkpoint_policy(save(payload()))

    class Odd(torch.nn.Module):
        def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
            return then(sample)

    with pytest.raises(SpecError, match=message):
        narrow(Odd(), spec, KEPT)
    assert unneeded(Odd(), spec) is None


def test_what_a_specification_leaves_out_is_checked_too(payload: Build, save: Save) -> None:
    module, spec = load_checkpoint_policy(save(payload(causal_attn=False)))
    with pytest.raises(SpecError, match=r"is 4, but these steps depend on the 2 after them"):
        ttscompile.compile_denoiser(module, replace(spec, sample=(KEPT, spec.sample[1]), left_out=HORIZON - KEPT))
    with pytest.raises(SpecError, match="prediction_horizon must be an integer of at least 1; found 0"):
        ttscompile.compile_denoiser(module, spec, prediction_horizon=0)


@pytest.mark.slow
def test_the_rest_of_the_prediction_is_the_original(payload: Build, save: Save, tmp_path: Path) -> None:
    """With the original's noise, given or drawn, in both runtimes, dense; and in the record that travels with it."""
    checkpoint = save(payload())
    module, original = load_checkpoint_policy(checkpoint)
    folder = tmp_path / "narrow"
    program = ttscompile.convert(checkpoint, folder, prediction_horizon=KEPT)
    artifact = load_artifact(folder)
    assert to_json(artifact.manifest.spec.whole_horizon) == to_json(original)
    # Of the original's FLOPs two thirds are left, and less where more than tokens counts.
    dense = artifact.plans["dense"].cells
    assert dense is not None
    assert artifact.manifest.flops.call(dense, pruned=False) < 0.7 * program.dense_flops

    obs = np.random.default_rng(0).standard_normal((STREAMS, 2, 5), dtype=np.float32)
    rng = np.random.default_rng(3)
    initial = rng.standard_normal((STREAMS, HORIZON, 3), dtype=np.float32)
    steps = rng.standard_normal((20, *initial.shape), dtype=np.float32)
    normalizers = original.observations["obs"].normalizer, original.chunk.normalizer
    assert normalizers[0] is not None
    assert normalizers[1] is not None
    given = {"obs": torch.from_numpy(normalizers[0].normalize(obs))}
    with Counted() as counted:
        sample = eager_policy(module, original)(given, ttscompile.Noise(initial, steps)).numpy()
    expected = normalizers[1].unnormalize(sample)
    cut = ttscompile.Noise(initial[:, :KEPT], steps[:, :, :KEPT])
    for runtime in ("reference", "onnxruntime"):
        policy = ttscompile.load(folder, runtime=runtime, seed=3)
        assert (policy.info.sample, policy.info.original_sample) == ((KEPT, 3), (HORIZON, 3))
        for noise in (None, ttscompile.Noise(initial, steps), cut):
            found = policy.predict_action({"obs": obs}, noise=noise)
            assert_equal_but_for_rounding(found["action_pred"], expected[:, :KEPT], counted.terms, counted.angle)
            assert_equal_but_for_rounding(found["action"], expected[:, 1:4], counted.terms, counted.angle)
    with pytest.raises(ObservationError, match=r"= \[2, 4, 3\]; found float32 \[2, 5, 3\]"):
        policy.predict_action({"obs": obs}, noise=ttscompile.Noise(initial[:, :5], steps))
    assert verify(folder).passed


def test_the_command_refuses_in_one_message(payload: Build, save: Save, tmp_path: Path) -> None:
    checkpoint = save(payload(causal_attn=False))
    result = CliRunner().invoke(
        main, ["convert", str(checkpoint), "-o", str(tmp_path / "a"), "--prediction-horizon", "4"]
    )
    assert result.exit_code == 2
    assert "Only where attention is causal can steps be left out" in result.stderr
    assert not (tmp_path / "a").exists()


def test_steps_left_out_are_a_number(payload: Build, save: Save) -> None:
    _, spec = load_checkpoint_policy(save(payload()))
    with pytest.raises(SpecError, match="left_out must be an integer of at least 0; found -1"):
        replace(spec, left_out=-1)


@pytest.mark.parametrize("name", FAMILIES)
def test_of_the_action_heads_smolvla_is_causal(name: str) -> None:
    """The rest attend to all steps; RDT-1B, CogACT, DiT-Policy and ScaleDP also hold tables of one length."""
    module, _, spec = loaded(FAMILIES[name](), name)
    executed = replace(spec, chunk=replace(spec.chunk, stop=2))
    if name == "smolvla":
        with Counted() as counted:
            difference = narrow(module, executed, 2)[1]
        assert difference < 5 * bound(counted.terms, counted.angle)
    else:
        with pytest.raises(SpecError, match=r"depend on the 4 after them|does not take a sample of 2 steps"):
            narrow(module, executed, 2)
