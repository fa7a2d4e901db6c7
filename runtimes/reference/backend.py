"""The reference as a backend: an artifact in, the same calls as every other runtime."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ttscompile.artifact.view import View
from ttscompile.core.lattice import PlanArray
from ttscompile.core.spec import FloatArray
from ttscompile.runtimes.backend import Call, fitting

from .model import ReferenceModel, noise_tensors
from .reuse import RolloutCache


class ReferenceBackend:
    """A ``Backend`` on ``ReferenceModel``, without gradients; what fails is an error of the artifact."""

    def __init__(self, view: View) -> None:
        self._view = view
        self.model = ReferenceModel.from_view(view)
        self.keeps = np.ones((self.model.steps, self.model.blocks), dtype=np.bool_)
        self._residuals: Mapping[tuple[int, int], Tensor] = {}

    def lower(self, plan: PlanArray) -> PlanArray:
        """The plan as it is."""
        return plan

    def prepare(self, streams: int, plans: Sequence[PlanArray] | None) -> None:
        """Nothing: torch takes memory as it goes."""

    def start(self, call: Call) -> None:
        self._call = call
        if not call.obs:
            return
        with fitting(self._view), torch.no_grad():
            self._contexts = self.model.prologue({key: torch.from_numpy(np.array(a)) for key, a in call.obs.items()})

    def condition(self) -> FloatArray:
        with fitting(self._view), torch.no_grad():
            return np.asarray(self.model.condition(self._contexts).numpy(), dtype=np.float32)

    def logits(self) -> FloatArray:
        with fitting(self._view), torch.no_grad():
            return np.asarray(self.model.logits(self._contexts).numpy(), dtype=np.float32)

    def first_step(self) -> None:
        """Nothing: the model takes all steps at once."""

    def other_steps(self, plans: Sequence[PlanArray]) -> FloatArray:
        call = self._call
        cache = RolloutCache(self._residuals if call.written.any() else {}, call.written)
        noise = noise_tensors(call.noise, self._view.manifest.spec.sampler.stochastic)
        with fitting(self._view), torch.no_grad():
            made = self.model.denoise(
                self._contexts, *noise, np.stack(plans), cache, correction=call.correction, known=call.known
            )
        self._residuals = made.cache.residuals
        return np.asarray(made.sample.numpy(), dtype=np.float32)
