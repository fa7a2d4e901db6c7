"""A policy whose calls begin with the chunk of the call before, and compute the last steps of the loop only.

    first call     noise                                               whole loop    chunk
    later calls    chunk, moved by what was executed, with new noise   last steps    chunk

This is a warm start (Falcon, arXiv 2503.00339). The whole loop and its last steps are artifacts of their own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.typed_json import to_json
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.core.start import Start
from ttscompile.errors import ArtifactError, NonFiniteActionsError, ObservationError

from .arrays import Array, check_noise, check_observation
from .frames import FrameWork
from .info import PolicyInfo
from .inpainting import check_prefix
from .policy import CompiledPolicy

NO_PREFIX = "its calls keep to the chunk of the call before already (it was loaded with warm=)"


class WarmPolicy(CompiledPolicy):
    """See ``load(warm=)``. The first call of an episode is the whole loop's, and all others are the rest's.

    A chunk is taken to have been executed as far as ``action`` goes when the next call is made: each call is one
    chunk later than the one before.

    Args:
        artifact: of the whole loop, and what else ``CompiledPolicy`` takes.
        rest: a policy of the last steps of the same loop; nobody else may call it.

    Raises:
        ArtifactError: ``rest`` is not the rest of this loop.
    """

    def __init__(self, artifact: Artifact, *arguments: Any, rest: CompiledPolicy) -> None:
        self._start = _require_rest(artifact, rest._artifact)
        self._rest = rest
        super().__init__(artifact, *arguments)
        self._prefix_refusal = NO_PREFIX

    @property
    def info(self) -> PolicyInfo:
        """Of the whole loop; ``warm_steps`` and ``identity`` are of both."""
        rest = self._rest.info
        both = hashlib.sha256(f"{super().info.identity} {rest.identity}".encode()).hexdigest()
        return replace(super().info, warm_steps=rest.K, identity=both)

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
        moved = np.minimum(np.arange(before.shape[1]) + spec.chunk.stop - spec.chunk.start, before.shape[1] - 1)
        initial = np.float32(self._start.action) * before[:, moved] + np.float32(self._start.noise) * fresh.initial
        steps = None if fresh.steps is None else fresh.steps[self._start.skipped :]
        self._report = self._sample = None  # a call that fails ends the episode
        try:
            actions = self._rest._predict(obs, Noise(initial, steps), None)
        except Exception as error:
            self._runtime.reset()
            if isinstance(error, NonFiniteActionsError):
                self._queues.reset()
            raise
        self._sample, self._report = self._rest._sample, self._rest._report
        return actions


def _require_rest(whole: Artifact, rest: Artifact) -> Start:
    """Where the rest begins. Specifications and timesteps are compared; weights are not.

    Raises:
        ArtifactError: it is not the rest of this loop.
    """
    one, other = whole.manifest.spec, rest.manifest.spec
    if one.start is not None:
        found = f"expected a whole loop; found {one.start.told(one.sampler.steps)} of {one.sampler.name}"
        raise ArtifactError(f"{whole.path}: {found}. Load it as ttscompile.load(WHOLE, warm=THIS).")
    if other.start is None:
        found = f"expected the last steps of a loop; found a whole one of {other.sampler.steps} steps"
        raise ArtifactError(f"{rest.path}: {found}. Convert the checkpoint with --last-steps.")
    ours, theirs = (to_json(replace(spec, sampler=one.sampler, start=None, source={})) for spec in (one, other))
    differ = [name for name in ours if ours[name] != theirs[name]]
    timesteps = one.sampler.timesteps[other.start.skipped :]
    if one.sampler.name != other.sampler.name or not np.array_equal(timesteps, other.sampler.timesteps):
        differ = ["sampler", *differ]
    if differ:
        expected = f"expected the rest of {whole.path}, of {one.sampler.steps} steps of {one.sampler.name}"
        found = f"{other.start.told(other.sampler.steps)} of {other.sampler.name}, with another {', '.join(differ)}"
        remedy = "Convert the same checkpoint with the same options and --last-steps"
        raise ArtifactError(f"{rest.path}: {expected}; found {found}. {remedy}.")
    return other.start
