"""A policy whose calls begin with the chunk of the call before, and compute the last steps of the loop only.

    first call     noise                                               whole loop    chunk
    later calls    chunk, moved by what was executed, with new noise   last steps    chunk

This is a warm start (Falcon, arXiv 2503.00339). The last steps are dense.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy.typing as npt

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.manifest import WARM
from ttscompile.artifact.rest import with_last_steps
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.errors import ArtifactError, NonFiniteActionsError, ObservationError

from .arrays import Array, check_noise, check_observation
from .frames import FrameWork
from .info import PolicyInfo
from .inpainting import check_prefix
from .policy import CompiledPolicy
from .runtime import Runtime

NO_PREFIX = "its calls keep to the chunk of the call before already (it was loaded with warm=)"


class WarmPolicy(CompiledPolicy):
    """See ``load(warm=)``. The first call of an episode computes the whole loop, and all others its last steps.

    A chunk is taken to have been executed as far as ``action`` goes when the next call is made: each call is one
    chunk later than the one before.

    Args:
        artifact: of the whole loop.
        runtime: opened on the same artifact.
        arguments: what else ``CompiledPolicy`` takes.
        last_steps: how many steps a later call computes.

    Raises:
        SpecError: there are no fewer steps, or they do not tell what they begin with (``core.rest``).
    """

    def __init__(self, artifact: Artifact, runtime: Runtime, *arguments: Any, last_steps: int) -> None:
        rest, self._start = with_last_steps(artifact, last_steps)
        super().__init__(artifact, runtime, *arguments)
        self._rest = CompiledPolicy(rest, runtime.of_last_steps(rest))
        self._prefix_refusal = NO_PREFIX

    @property
    def info(self) -> PolicyInfo:
        """Of the whole loop; ``warm_steps`` and ``identity`` say how many steps later calls compute."""
        own, steps = super().info, self._rest.info.K
        both = hashlib.sha256(f"{own.identity} last {steps}".encode()).hexdigest()
        return replace(own, warm_steps=steps, identity=both)

    def _reset(self) -> None:
        super()._reset()
        self._rest._reset()

    def prepare_frame(self, frame: Mapping[str, Any], stop: Callable[[], bool] = lambda: False) -> FrameWork:
        """See ``CompiledPolicy``: for whichever loop the next call computes."""
        if self._sample is None:
            return super().prepare_frame(frame, stop)
        with self._turn():
            return self._rest.prepare_frame(frame, stop)

    def forget_frames(self) -> None:
        """See ``CompiledPolicy``."""
        with self._turn():
            self._runtime.forget_frames()
            self._rest.forget_frames()

    def _predict(
        self, obs: Mapping[str, Array], noise: Noise | None, plan: str | npt.ArrayLike | None, prefix: Any = None
    ) -> FloatArray:
        """One call; ``noise`` is that of the whole loop, and ``plan`` is of calls that compute it."""
        spec, before = self._manifest.spec, self._sample
        obs = check_observation(obs, spec.observations)
        streams = len(next(iter(obs.values())))
        if prefix is not None:
            check_prefix(prefix, streams, spec, self._prefix_refusal)
        if before is None:
            return super()._predict(obs, noise, plan)
        if streams != len(before):
            found = f"the observation holds {streams} streams, and the episode under way {len(before)}"
            raise ObservationError(f"{found}. Call reset() before changing the number of streams.")
        self._plan(plan)  # which is not of this call, but may be of no artifact
        fresh = check_noise(self._draw(streams) if noise is None else noise, streams, spec)
        self._report = self._sample = None  # a call that fails ends the episode
        try:
            actions = self._rest._predict(obs, self._start.noise_from(before, spec.chunk, fresh), WARM)
        except Exception as error:
            self._runtime.reset()
            if isinstance(error, NonFiniteActionsError):
                self._queues.reset()
            raise
        self._sample, self._report = self._rest._sample, self._rest._report
        return actions


def settled_steps(artifact: Artifact) -> int:
    """The number of last steps that was settled for an artifact.

    Raises:
        ArtifactError: there is none.
    """
    record = artifact.manifest.warm
    if record is None:
        remedy = f"Run 'ttscompile warm-start {artifact.path} --trajectories FILE', or give a number of steps"
        raise ArtifactError(f"{artifact.path}: how many steps a warm call needs was not settled. {remedy}: warm=3.")
    return record.last_steps
