"""What may say that the chunk of the call before no longer holds: a check by the network, a forecast, or chance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from falcon import output_of
from variants import full_plan

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.spec import FloatArray
from ttscompile.errors import TtscompileError
from ttscompile.runtimes.inpainting import noise_levels
from ttscompile.runtimes.reference.model import ReferenceModel

RIDGE = 1e-3
"""Of the forecast, for each call that it is fitted on."""

Array = npt.NDArray[Any]


@dataclass
class Going:
    """What calls go on with, of all streams.

    Attributes:
        chunk: normalised ``[B, T, D]``, moved by what was executed.
        noise: that it was drawn with, likewise.
        left: actions that were predicted and are left, ``[B]``.
        seen: observation of the call before, ``[B, N]``.
        done: actions since then, normalised, ``[B, h * D]``.
        pictures: by key, those that the chunk was drawn with.
    """

    chunk: FloatArray
    noise: FloatArray
    left: npt.NDArray[np.int64]
    seen: FloatArray
    done: FloatArray
    pictures: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """Of streams: how far each is from what was expected, and what to execute in place of the chunk before, if any."""

    distances: npt.NDArray[np.float64]
    clean: FloatArray | None = None


class Doubt(Protocol):
    """Says how far a chunk is from one that still holds."""

    evaluations: int

    def reset(self) -> None:
        """A new episode."""

    def judge(self, obs: Mapping[str, Array], fresh: FloatArray, going: Going) -> Verdict:
        """See ``Verdict``. ``fresh`` is the noise of this call, ``[B, T, D]``."""


class Check:
    """One evaluation of the network at a step of the whole loop.

    Args:
        directory: of an artifact.
        step: whose level of noise the chunk gets.
        answered: whether the network's clean chunk is executed where it is near enough.
        blind: whether it sees the pictures that the chunk was drawn with, and of what is new the state alone.
    """

    evaluations = 1

    def __init__(self, directory: Path, step: int, answered: bool = False, blind: bool = False) -> None:
        artifact = load_artifact(directory)
        view = view_of(artifact, artifact.plan(full_plan(directory)))
        self._spec, levels = view.manifest.spec, noise_levels(view.manifest.spec.sampler)
        if levels is None or not 0 < step < self._spec.sampler.steps:
            raise TtscompileError(f"{directory}: its loop gives no level of noise before a step {step}.")
        if blind and not any(one.image for one in self._spec.observations.values()):
            raise TtscompileError(f"{directory}: it sees no pictures, so a check has none to keep. Leave out 'blind'.")
        self._model, self._step, self._answered, self.blind = ReferenceModel.from_view(view), step, answered, blind
        self._signal, self._deviation = (np.float32(one[step]) for one in levels)

    def reset(self) -> None:
        """Nothing is kept."""

    def judge(self, obs: Mapping[str, Array], fresh: FloatArray, going: Going) -> Verdict:
        """See ``Doubt``."""
        specs, table, k = self._spec.observations, self._spec.sampler, self._step
        obs = {**obs, **going.pictures} if self.blind else obs
        given = {key: torch.from_numpy(spec.normalized(np.asarray(obs[key]))) for key, spec in specs.items()}
        sample = self._signal * going.chunk + self._deviation * going.noise
        with torch.no_grad():
            contexts = self._model.prologue(given)
            out = output_of(self._model, torch.from_numpy(sample), k, contexts)
        clean = table.sample_to_x0[k] * sample + table.out_to_x0[k] * out.numpy()
        clean = clean if table.clip is None else clean.clip(-table.clip, table.clip)
        start = self._spec.chunk.start
        places = np.arange(clean.shape[1])[None] - start
        counted = ((places >= 0) & (places < going.left[:, None]))[..., None]
        apart = (np.abs(clean - going.chunk) * counted).sum((1, 2))
        distances = apart / np.maximum(counted.sum((1, 2)) * clean.shape[2], 1)
        return Verdict(distances, clean if self._answered else None)


class Forecast:
    """A linear map of what was observed and done to what is observed next; see ``fit``."""

    evaluations = 0

    def __init__(self, weights: FloatArray, scale: FloatArray) -> None:
        self._weights, self._scale = weights, scale

    @classmethod
    def fit(cls, known: FloatArray, following: FloatArray) -> Forecast:
        """By ridge regression, of calls ``[N, F]`` and what was observed after each ``[N, O]``."""
        rows = np.concatenate([known, np.ones((len(known), 1), np.float32)], 1)
        gram = rows.T @ rows + RIDGE * len(rows) * np.eye(rows.shape[1])
        weights = np.linalg.solve(gram, rows.T @ following)
        return cls(weights.astype(np.float32), (following - rows @ weights).std(0) + 1e-6)

    def reset(self) -> None:
        """Nothing is kept."""

    def judge(self, obs: Mapping[str, Array], fresh: FloatArray, going: Going) -> Verdict:
        """See ``Doubt``: the largest difference of a number, in its deviations."""
        known = np.concatenate([going.seen, going.done, np.ones((len(going.seen), 1), np.float32)], 1)
        return Verdict(np.abs((flat(obs) - known @ self._weights) / self._scale).max(1).astype(np.float64))


class Chance:
    """Calls by chance; a distance is uniform in 0..1."""

    evaluations = 0

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The same chances in every episode."""
        self._rng = np.random.default_rng(0)

    def judge(self, obs: Mapping[str, Array], fresh: FloatArray, going: Going) -> Verdict:
        """See ``Doubt``."""
        return Verdict(self._rng.random(len(fresh)))


def flat(obs: Mapping[str, Array]) -> FloatArray:
    """Numbers of the newest frames that are no pictures, ``[B, N]``."""
    return np.concatenate([one[:, -1] for one in obs.values() if one.ndim == 3], 1).astype(np.float32)
