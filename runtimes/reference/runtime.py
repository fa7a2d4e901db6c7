"""The reference as a runtime: an artifact in, the same calls as every other runtime."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from ttscompile.core.correction import Correction
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.ir.pieces import PRUNER
from ttscompile.runtimes.base import (
    GIVEN,
    CallReport,
    Timings,
    check_call,
    computed_cells,
    fitting,
    frozen,
    milliseconds,
    no_pruner,
    pruner_plan,
    settle_plan,
)
from ttscompile.runtimes.inpainting import Known

from .model import ReferenceModel, noise_tensors
from .reuse import RolloutCache

if TYPE_CHECKING:
    from ttscompile.artifact.load import Artifact


class ReferenceRuntime:
    """A ``Runtime`` on ``ReferenceModel``; see ``base.Runtime``.

    Attributes:
        model: what it runs.
    """

    def __init__(self, artifact: Artifact) -> None:
        self._artifact = artifact
        self.model = ReferenceModel.from_artifact(artifact)
        self._manifest = artifact.manifest
        self._cache: RolloutCache | None = None

    @property
    def streams(self) -> int | None:
        """B of the episode under way."""
        return None if self._cache is None else len(self._cache.written)

    def reset(self) -> None:
        """Forget the rollout cache."""
        self._cache = None

    def predict(
        self,
        obs: Mapping[str, FloatArray],
        noise: Noise,
        plan: npt.ArrayLike | None = None,
        *,
        plan_name: str | None = None,
        repair: bool = False,
        correction: Correction | None = None,
        known: Known | None = None,
    ) -> tuple[FloatArray, CallReport]:
        """Denoise one chunk; see ``base.Runtime.predict``."""
        spec = self._manifest.spec
        streams = check_call(self.streams, noise, spec.sample, spec.sampler)
        cache = self._cache if self._cache is not None else self.model.empty_cache(streams)
        pruned = plan is None
        if plan is None:
            if PRUNER not in self._manifest.pieces:
                raise no_pruner()
        else:
            plans, legalised = settle_plan(plan, self.model.groups, cache.written, repair)
        start = time.perf_counter()
        self.reset()  # a call that fails from here on ends the episode
        with fitting(self._artifact), torch.no_grad():
            contexts = self.model.prologue({key: torch.from_numpy(np.array(value)) for key, value in obs.items()})
            prologue = time.perf_counter()
            if pruned:
                wanted = pruner_plan(self.model.logits(contexts).numpy())
                plans, legalised = settle_plan(wanted, self.model.groups, cache.written, True)
            pruner = time.perf_counter()
            initial, steps = noise_tensors(noise, spec.sampler.stochastic)
            result = self.model.rollout(contexts, initial, steps, plans, cache, correction=correction, known=known)
        self._cache = result.cache
        stop = time.perf_counter()
        wait = milliseconds(prologue, pruner) if pruned else 0.0
        report = CallReport(
            plan=frozen(plans),
            plan_name=plan_name or (PRUNER if pruned else GIVEN),
            computed=computed_cells(plans),
            legalised=legalised,
            flops=tuple(self._manifest.flops.call(one, pruned) for one in plans),
            timings=Timings(
                prologue=milliseconds(start, prologue),
                pruner=wait,
                wait_pruner=wait,
                decode=milliseconds(pruner, stop),
                total=milliseconds(start, stop),
            ),
        )
        return np.asarray(result.sample.numpy(), dtype=np.float32), report
