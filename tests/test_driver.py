"""``compile_denoiser`` on modules that nobody prepared, from the module to both runtimes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import ttscompile
from tests.passes.modules import MODULES, spec
from tests.rounding import Counted, assert_equal_but_for_rounding, bound
from tests.runtimes.agreement import call_terms, largest_difference
from ttscompile.artifact import load_artifact
from ttscompile.runtimes import open_runtime

STREAMS = 3


def policy_stream(name: str) -> tuple[int, ...]:
    """Shape of one stream's residuals, wherever the module keeps its streams: four tokens of the module's width.

    A network that is one block has the sample beside the prediction.
    """
    return (4, {"bare observation": 2, "U-Net": 4}.get(name, 16))


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_from_a_module_to_both_runtimes(name: str, compiled_module: Callable[[str], tuple[nn.Module, Path]]) -> None:
    module, folder = compiled_module(name)
    rng = np.random.default_rng(0)
    obs = rng.standard_normal((STREAMS, 3, 7), dtype=np.float32)
    noise = ttscompile.Noise(rng.standard_normal((STREAMS, 4, 2), dtype=np.float32))
    sample = torch.from_numpy(noise.initial)
    with torch.no_grad(), Counted() as counted:
        for t in spec().sampler.timesteps:
            sample = sample - 0.1 * module(sample, torch.full((STREAMS,), int(t)), torch.from_numpy(obs))
    for runtime in ("reference", "onnxruntime"):
        policy = ttscompile.load(folder / "artifact", runtime=runtime)
        assert {block.shape for block in policy.info.blocks} == {policy_stream(name)}
        found = policy.predict_action({"obs": obs}, noise=noise, plan="dense")["action_pred"]
        assert_equal_but_for_rounding(found, sample, counted.terms, counted.angle)

    artifact = load_artifact(folder / "artifact")
    left, right = open_runtime(artifact, "onnxruntime"), open_runtime(artifact, "reference")
    for streams in (1, STREAMS):
        assert largest_difference(artifact, left, right, rng, streams, calls=4) < bound(call_terms(artifact))
