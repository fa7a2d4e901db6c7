"""The policy in eager PyTorch: what the compiled one is measured against."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

import ttscompile
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy

sys.path.append(str(Path(__file__).resolve().parents[1] / "evaluation"))
from variants import NoiseShape, Plan


class EagerPolicy:
    """A checkpoint's whole network, run once a denoising step by PyTorch, behind the interface of a compiled policy.

    It leaves out diffusers' scheduler, which the original calls at each step, and so is a little faster than that.

    Attributes:
        noise: sizes of its noise.
    """

    def __init__(self, checkpoint: Path, threads: int) -> None:
        torch.set_num_threads(threads)
        module, self._spec = load_checkpoint_policy(checkpoint)
        self._run = eager_policy(module, self._spec)
        self.noise = NoiseShape(self._spec.sampler.steps, self._spec.sample, self._spec.sampler.stochastic)

    def reset(self) -> None:
        """Nothing is kept between calls."""

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: Plan | None = None
    ) -> dict[str, Any]:
        """Windows ``{key: [B, To, Do]}`` in, ``{"action": [B, Ta, Da], "action_pred": [B, T, Da]}`` out, float32."""
        if noise is None or not (plan is None or (isinstance(plan, str) and plan == "dense")):
            raise ValueError(f"the eager policy needs its noise, and computes everything; found plan {plan!r}.")
        normalised = {}
        for key, spec in self._spec.observations.items():
            normalised[key] = torch.from_numpy(spec.normalized(np.asarray(obs_dict[key], dtype=spec.dtype)))
        chunk = self._spec.chunk
        actions = chunk.unnormalized(self._run(normalised, noise).numpy())
        return {"action": actions[:, chunk.start : chunk.stop], "action_pred": actions}
