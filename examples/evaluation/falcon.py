"""Falcon: calls that begin with samples of the call before, and the network at several steps in one evaluation.

``whole_calls.py`` drives with it, and says what it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import View, view_of
from ttscompile.errors import TtscompileError
from ttscompile.ir.program import Binding
from ttscompile.runtimes.info import PolicyInfo
from ttscompile.runtimes.inpainting import noise_levels
from ttscompile.runtimes.reference.model import Contexts, ReferenceModel
from ttscompile.runtimes.reference.sampler import TorchSampler

EXPLORED = 0.1
"""Share of Falcon's calls that begin with noise whatever the threshold says."""


@dataclass
class Count:
    """What calls took so far, of all streams.

    Attributes:
        calls: that there were, left out or not.
        steps: evaluations that were steps of the loop.
        checks: evaluations that looked for where to begin.
        looking: seconds of these.
    """

    calls: int = 0
    steps: int = 0
    checks: int = 0
    looking: float = 0.0


def output_of(model: ReferenceModel, sample: torch.Tensor, k: int, contexts: Contexts) -> torch.Tensor:
    """What the network gives ``[B, T, D]`` for a sample at step k, with every block computed."""

    def blocks(k: int, hidden: torch.Tensor) -> torch.Tensor:
        for b in range(model.blocks):
            hidden = hidden + model.block(b, k, hidden, contexts)
        return hidden

    return model.predict(sample, k, contexts, blocks)


class ManySteps:
    """A network at several steps in one evaluation: each row of the batch is of a stream and a step.

    What the network reads of a step are rows of tables, which a loop takes one after the other. Here they are given as
    what depends on the observation is, a row for each row of the batch.

    Args:
        view: whose loop has these steps.

    Raises:
        TtscompileError: what it reads of a step has no row for each stream.
    """

    def __init__(self, view: View) -> None:
        pieces, manifest = view.pieces, view.manifest
        types = dict(pieces.step.inputs) if pieces.step is not None else {}
        for piece in (pieces.stem, *pieces.blocks, pieces.tail):
            types |= piece.contexts
        self._axes, self._rows = dict[str, int](), dict[str, torch.Tensor]()
        for name, kind in types.items():
            if pieces.bindings[name] is Binding.TABLE:
                if kind.batch_axis is None:
                    raise TtscompileError(f"{name}: it is the same for all streams. Evaluate one step after the other.")
                self._axes[name], self._rows[name] = kind.batch_axis, torch.from_numpy(np.array(pieces.tables[name]))
        self._conditions = {name: kind.batch_axis for name, kind in pieces.conditions.items()}
        given = {name: Binding.CONDITION if name in self._rows else one for name, one in pieces.bindings.items()}
        self._model = ReferenceModel(
            replace(pieces, bindings=given),
            manifest.spec,
            [block.type for block in manifest.blocks],
            manifest.groups,
            {**view.weights, **view.pruner},
        )

    def outputs(self, samples: Sequence[torch.Tensor], steps: Sequence[int], contexts: Contexts) -> list[torch.Tensor]:
        """What the network gives ``[B, T, D]`` for each sample ``[B, T, D]`` at its step, none of which is step 0."""
        count, streams = len(steps), contexts.streams
        given = dict[str, torch.Tensor]()
        for name, value in contexts.condition.items():
            axis = self._conditions[name]
            given[name] = value if axis is None else torch.cat([value] * count, axis)
        for name, axis in self._axes.items():
            rows = self._rows[name]
            shape = [streams if i == axis else n for i, n in enumerate(rows.shape[1:])]
            given[name] = torch.cat([rows[k].expand(shape) for k in steps], axis)
        whole = Contexts(count * streams, given)
        return list(output_of(self._model, torch.cat(list(samples)), steps[0], whole).split(streams))


class Falcon:
    """A policy whose calls begin with samples of the call before, where those are near enough.

    Args:
        directory: of an artifact.
        plan: that computes every cell.
        threshold: mean absolute difference of normalised actions.
        least: steps of a call.
        seed: of which calls begin with noise.
        together: look at all samples that a call could begin with in one evaluation.
    """

    def __init__(
        self, directory: Path, plan: str, threshold: float, least: int = 1, seed: int = 0, together: bool = True
    ) -> None:
        artifact = load_artifact(directory)
        view = view_of(artifact, artifact.plan(plan))
        self._spec, levels = view.manifest.spec, noise_levels(view.manifest.spec.sampler)
        if levels is None or self._spec.sampler.memories or self._spec.sampler.stochastic:
            raise TtscompileError(f"{directory}: its loop is no deterministic one of one step. Use --sampler ddim.")
        self._model, self._sampler = ReferenceModel.from_view(view), TorchSampler(self._spec.sampler)
        self._many = ManySteps(view) if together else None
        self._signal, self._deviation = (torch.from_numpy(one.astype(np.float32)) for one in levels)
        if least > (steps := self._spec.sampler.steps):
            raise TtscompileError(f"{directory}: its loop has {steps} steps; {least} cannot be left.")
        self._threshold, self._least, self._seed, self.count = threshold, least, seed, Count()
        self.info: PolicyInfo = ttscompile.load(directory, plan=plan).info
        self.reset()

    def reset(self) -> None:
        """A new episode."""
        self._samples: list[torch.Tensor] = []
        self._rng = np.random.default_rng(self._seed)

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: object = None
    ) -> Mapping[str, Any]:
        """One call."""
        specs, chunk = self._spec.observations, self._spec.chunk
        obs = {key: torch.from_numpy(spec.normalized(np.asarray(obs_dict[key]))) for key, spec in specs.items()}
        assert noise is not None
        with torch.no_grad():
            contexts, initial = self._model.prologue(obs), torch.from_numpy(noise.initial)
            begins, begun = self._beginnings(contexts, initial)
            samples, following, streams = list[torch.Tensor](), initial, len(initial)
            for k in range(self._model.steps):
                samples.append(torch.where((begins >= k)[:, None, None], begun[k], following))
                output = output_of(self._model, samples[k], k, contexts)
                following = self._sampler.advance(self._sampler.begin(samples[k]), output, None, k).sample
            samples.append(following)
        self._samples = samples
        self.count.calls += streams
        self.count.steps += int((self._model.steps - begins).sum())
        actions = chunk.unnormalized(samples[-1].numpy(), chunk.reference(dict(obs_dict)))
        return {"action": actions[:, chunk.start : chunk.stop]}

    def _beginnings(self, contexts: Contexts, initial: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """At which step each stream begins; and the samples to begin with, by step."""
        steps, chunk = self._model.steps, self._spec.chunk
        begun, begins = [initial] * steps, torch.zeros(len(initial), dtype=torch.int64)
        looked = range(1, steps - self._least + 1)
        if not self._samples or not looked:
            return begins, begun
        moved = chunk.stop - chunk.start
        planned = self._samples[-1]
        ahead = torch.cat([planned[:, moved:], planned[:, -1:].expand(-1, moved, -1)], 1)
        free = torch.from_numpy(self._rng.random(len(initial)) >= EXPLORED)
        for k in looked:
            tail = self._signal[k] * ahead[:, -moved:] + self._deviation[k] * initial[:, -moved:]
            begun[k] = torch.cat([self._samples[k][:, moved:], tail], 1)
        began = perf_counter()
        for k, clean in zip(looked, self._clean([begun[k] for k in looked], looked, contexts), strict=True):
            near = (clean - ahead)[:, :-moved].abs().mean((1, 2)) < self._threshold
            begins = torch.where(near & free, k, begins)
        self.count.looking += perf_counter() - began
        self.count.checks += len(looked) * len(initial)
        return begins, begun

    def _clean(self, samples: Sequence[torch.Tensor], steps: Sequence[int], contexts: Contexts) -> list[torch.Tensor]:
        """The clean chunk that one evaluation makes of each sample at its step."""
        table = self._spec.sampler
        if self._many is not None:
            outputs = self._many.outputs(samples, steps, contexts)
        else:
            outputs = [output_of(self._model, one, k, contexts) for one, k in zip(samples, steps, strict=True)]
        cleaned = list[torch.Tensor]()
        for sample, k, output in zip(samples, steps, outputs, strict=True):
            clean = table.sample_to_x0[k] * sample + table.out_to_x0[k] * output
            cleaned.append(clean if table.clip is None else clean.clamp(-table.clip, table.clip))
        return cleaned
