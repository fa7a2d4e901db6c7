"""A policy that VDD distilled, wrapped as ``docs/howto/own-denoiser.md`` has it, against what the original did."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

import ttscompile
from tests.families.checks import golden
from tests.families.support import record
from tests.families.vdd import Experts
from tests.families.weights import draw_weights
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import ChunkSpec, DirectDenoiser, ObservationSpec, PolicySpec, direct_table


def test_a_wrapped_policy_acts_as_the_original(tmp_path: Path) -> None:
    """In every runtime; more than one expert is asked."""
    arrays = golden("vdd")
    observed = {name: arrays[name] for name in ("window", "goal")}
    (_, frames, numbers), goals, action = (
        observed["window"].shape,
        observed["goal"].shape[1],
        arrays["actions"].shape[1],
    )
    experts = Experts(numbers, action, 4, frames, goals)
    experts.load_state_dict(
        draw_weights({key: tuple(value.shape) for key, value in experts.state_dict().items()}, int(arrays["seed"]))
    )
    module = DirectDenoiser(experts).eval()
    sample = torch.zeros(len(arrays["actions"]), 1, action)
    with torch.no_grad(), Counted() as counted:
        made = module(sample, sample[:, 0, 0], **{key: torch.from_numpy(value) for key, value in observed.items()})
    assert_equal_but_for_rounding(made[:, 0], arrays["actions"], counted.terms, counted.angle)
    assert len(np.unique(arrays["chosen"])) > 2

    observations = {key: ObservationSpec(value.shape[1:]) for key, value in observed.items()}
    spec = PolicySpec((1, action), observations, direct_table(), ChunkSpec(action, 0, 1))
    program = ttscompile.compile_denoiser(module, spec, tmp_path / "compiled")
    record(
        "VDD, its experts in a wrapper (one evaluation, nothing to reuse)",
        "vdd e1395f3 `GaussianMoE.act` with `greedy_predict`, up to the rounding of float32",
        "direct 1",
        program,
    )
    for runtime in ("reference", "onnxruntime"):
        policy = ttscompile.load(tmp_path / "compiled", runtime=runtime)
        found = policy.predict_action(observed, noise=ttscompile.Noise(sample.numpy()), plan="dense")["action"]
        assert_equal_but_for_rounding(found[:, 0], arrays["actions"], counted.terms, counted.angle)
