"""An original computes where its weights are: on a GPU too, beside which the compiled policy is timed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import evaluation

from . import acts, evo1s, groots, pis, vla_jepas, xvlas

TRAINED = Path(__file__).parents[2] / "examples" / "policies" / "vla" / "trained"

SAVED: dict[str, Callable[[Path], Path]] = {
    "act": lambda folder: acts.save(next(iter(acts.VARIANTS)), folder),
    "evo1": lambda folder: evo1s.save("words", folder),
    "groot": lambda folder: groots.save("words", folder),
    "pi0": lambda folder: pis.save("pi0", folder),
    "pi05": lambda folder: pis.save("pi05", folder),
    "vla_jepa": lambda folder: vla_jepas.save("libero", folder),
    "xvla": lambda folder: xvlas.save("ee6d", folder),
    "multi_task_dit": lambda _: TRAINED / "multi_task_dit" / "policy",
    "smolvla": lambda _: TRAINED / "smolvla" / "policy",
}


@pytest.mark.parametrize("name", SAVED)
def test_nothing_of_an_evaluation_is_left_on_the_processor(name: str, tmp_path: Path) -> None:
    """On torch's device of tensors without numbers, which most operations refuse to mix with the CPU's."""
    module, spec = load_checkpoint_policy(SAVED[name](tmp_path / "policy"))
    device = torch.device("meta")
    module.to(device)
    obs = {
        key: torch.empty((1, *one.shape), dtype=getattr(torch, one.dtype), device=device)
        for key, one in spec.observations.items()
    }
    timestep = torch.from_numpy(spec.sampler.timesteps)[:1].to(device)
    with torch.inference_mode():
        made = evaluation(module, spec, obs)(torch.empty((1, *spec.sample), device=device), timestep)
    assert made.device == device and made.shape == (1, *spec.sample)
