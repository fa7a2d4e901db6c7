"""The pieces of a policy for one call, in operations that a compiler or an exporter sees as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from ttscompile.artifact.view import View
from ttscompile.core.coercion import Arrays
from ttscompile.core.correction import Correction
from ttscompile.core.envelope import FAR, plain_cells
from ttscompile.core.spec import Affine
from ttscompile.errors import ObservationError
from ttscompile.ir.evaluate import Evaluator
from ttscompile.ir.idle_form import idle_form
from ttscompile.ir.pieces import PRUNER, STEM, STEP, TAIL, block_name
from ttscompile.ir.program import Binding, once_values

from .sampler import Advance, IdleSteps

Tensors = Mapping[str, Tensor]


class PlainNetwork:
    """``loop.Network`` of one call; the prologue is computed when it is made.

    Args:
        module: whose pieces these are, and whose constants as they are in the call.
        obs: normalised, by key.
        streams: B.

    Attributes:
        idle: see ``loop.Network``.
        stream_type: of the residual stream.
    """

    def __init__(self, module: CallModule, obs: Tensors, streams: int) -> None:
        self._pieces = pieces = module.pieces
        self._evaluators = evaluators = module.evaluators
        self._weights = weights = module.kept("weight")
        self._first, self._tables = module.kept("first weight"), module.kept("table")
        self.idle = None if module.idle is None else module.idle.on(module.kept("idle"))
        self._streams = streams
        self.stream_type = pieces.blocks[0].type
        made = once_values(pieces, lambda name, given: evaluators[name]({**weights, **given}), obs)
        self._condition = {name: made[name] for name in pieces.conditions}
        self._by_step: dict[int, dict[str, Tensor]] = {}  # step values, of steps that read them
        # Of every piece what it reads, and of every context the axis of streams: plain names, which a tracer follows.
        graphs = pieces.graphs()
        self._reads = {name: (*graph.inputs, *graph.constants) for name, graph in graphs.items()}
        self._axes = {name: kind.batch_axis for graph in graphs.values() for name, kind in graph.inputs.items()}
        self._blocks = tuple(map(block_name, range(len(pieces.blocks))))  # no text is made while something is traced
        self._streams_of = {name: piece.stream for name, piece in pieces.loop.items()}

    def of(self, members: Tensor) -> PlainNetwork:
        """The same for some of the streams."""
        other, types = copy(self), self._pieces.conditions
        other._streams, other._by_step = len(members), {}
        axes = {name: types[name].batch_axis for name in self._condition}
        other._condition = {
            name: value if (axis := axes[name]) is None else value.index_select(axis, members)
            for name, value in self._condition.items()
        }
        return other

    def apart(self) -> PlainNetwork:
        """The same with condition values that share no memory, which a loop of ``torch.export`` wants."""
        other, read = copy(self), {name for piece in self._pieces.graphs().values() for name in piece.inputs}
        other._condition = {n: value.clone() for n, value in self._condition.items() if n in read}
        return other

    def know_steps(self, steps: int) -> None:
        """Compute all step values: in a branch of ``torch.cond`` nothing can be kept."""
        if self._pieces.step is not None:
            for k in range(steps):
                self._step(k)

    def condition(self, features: Sequence[str]) -> Tensor:
        """What a correction reads, ``[B, N]``."""
        types = self._pieces.conditions
        rows = [self._condition[name].movedim(types[name].batch_axis or 0, 0) for name in features]
        return torch.cat([row.reshape(self._streams, -1) for row in rows], 1)

    def logits(self) -> Tensor:
        """The pruner's, ``[B, K, blocks, 4]``."""
        return self._run(PRUNER, {**self._weights, **self._condition})[0]

    def stem(self, sample: Tensor, k: int) -> Tensor:
        return self._at(k, STEM, sample)

    def block(self, b: int, k: int, hidden: Tensor) -> Tensor:
        return self._at(k, self._blocks[b], hidden)

    def tail(self, hidden: Tensor, k: int) -> Tensor:
        return self._at(k, TAIL, hidden)

    def contexts(self, k: Tensor) -> dict[str, Tensor]:
        """All that the pieces of the loop read at a step that only the program knows, int64 ``[1]``; by name."""
        rows = {name: self._repeated(name, table.index_select(0, k)[0]) for name, table in self._tables.items()}
        first = {name: torch.where((k > 0)[0], self._weights[name], own) for name, own in self._first.items()}
        known = {**self._weights, **first, **self._condition, **rows}
        return known if self._pieces.step is None else {**known, **self._step_values(known)}

    def run(self, name: str, value: Tensor, contexts: Tensors) -> Tensor:
        """A piece of the loop on a sample or a stream."""
        return self._run(name, {**contexts, self._streams_of[name]: value})[0]

    def _at(self, k: int, name: str, value: Tensor) -> Tensor:
        hidden = self._streams_of[name]
        reads = {read: self._context(read, k) for read in self._reads[name] if read in self._axes and read != hidden}
        return self._run(name, {**self._weights, **({} if k else self._first), hidden: value, **reads})[0]

    def _run(self, name: str, values: Tensors) -> tuple[Tensor, ...]:
        return self._evaluators[name].run([values[read] for read in self._reads[name]], self._streams)

    def _context(self, name: str, k: int) -> Tensor:
        binding = self._pieces.bindings[name]
        if binding is Binding.CONDITION:
            return self._condition[name]
        if binding is Binding.STEP:
            return self._step(k)[name]
        return self._repeated(name, self._tables[name][k])

    def _repeated(self, name: str, row: Tensor) -> Tensor:
        axis = self._axes[name]
        return row.expand([self._streams if i == axis else n for i, n in enumerate(row.shape)])

    def _step(self, k: int) -> dict[str, Tensor]:
        step = self._pieces.step
        assert step is not None
        if k not in self._by_step:
            reads = {name: self._context(name, k) for name in step.inputs}
            self._by_step[k] = self._step_values({**self._weights, **reads})
        return self._by_step[k]

    def _step_values(self, reads: Tensors) -> dict[str, Tensor]:
        step = self._pieces.step
        assert step is not None
        return dict(zip(step.outputs, self._run(STEP, reads), strict=True))


CPU = torch.device("cpu")


class CallModule(nn.Module):
    """A call of a policy. Every constant is a buffer; nothing is a parameter, or kept from call to call.

    Attributes:
        spec: what goes in and comes out.
        pieces: of the artifact.
        evaluators: of all pieces. Constants are inputs, which an exporter puts others in the place of.
        idle: see ``loop.Network``, with the constants as they were.
    """

    def __init__(self, view: View, weights: Arrays, advance: Advance, correction: Correction | None) -> None:
        super().__init__()
        manifest, pieces = view.manifest, view.pieces
        self.spec, self.pieces, self._features = manifest.spec, pieces, manifest.features
        self._names: dict[str, str] = {}  # of buffers, by what they hold
        constants = {name for graph in pieces.graphs().values() for name in graph.constants}
        self._keep("weight", {name: value for name, value in weights.items() if name in constants})
        self._keep("first weight", view.first_weights)
        self._keep("table", pieces.tables)
        self._advance = advance
        self._bound = None if correction is None else manifest.spec.sampler.bound
        self._keep("advance", self._advance.tensors())
        form, _ = idle_form(pieces, view.weights)
        self.idle = None if form is None else IdleSteps(form, CPU)
        self._keep("idle", {} if self.idle is None else self.idle.tensors())
        bias = np.zeros((1, 1, 1, 1), np.float32) if correction is None else correction.bias
        self._keep("offset", {"noise": manifest.spec.sampler.noise_to_next[:, None, None, None], "bias": bias})
        envelope = view.artifact.envelope
        self._far: Advance | None = None
        if correction is not None and envelope is not None:
            self._far = type(advance)(manifest.spec, None, CPU)
            self._keep("far", self._far.tensors())
            self._keep("envelope", {"reading": envelope.reading, "center": envelope.center})
            self._plain_cells = plain_cells(correction, len(manifest.blocks))
        for key, each in manifest.spec.observations.items():
            self._keep(f"normalizer {key}", _numbers(each.normalizer))
        own = manifest.spec.chunk.normalizer
        self._keep("actions", _numbers(None if own is None else own.at(slice(manifest.spec.sample[0]))))
        self.evaluators = {
            name: Evaluator(replace(graph, inputs={**graph.inputs, **graph.constants}, constants={}), {})
            for name, graph in pieces.graphs().items()
        }

    def _network(self, obs: Mapping[str, Tensor], initial: Tensor) -> PlainNetwork:
        spec = self.spec
        horizon, dimensions = spec.sample
        if initial.ndim != 3 or tuple(initial.shape[1:]) != spec.sample or initial.dtype != torch.float32:
            found = f"{initial.dtype} {list(initial.shape)}"
            raise ObservationError(f"initial must be float32 [B, T, D] = [B, {horizon}, {dimensions}]; found {found}.")
        count = torch.zeros((len(initial), 1), dtype=torch.int64, device=initial.device)
        given = dict.fromkeys(spec.committed(0), count)  # nothing is: the module takes no prefix
        for key, one in spec.observations.items():
            value = obs.get(key)
            shape = None if value is None else tuple(value.shape)
            if value is None or shape != (len(initial), *one.shape) or value.dtype != getattr(torch, one.dtype):
                expected = f"{one.dtype} [{', '.join(map(str, (len(initial), *one.shape)))}]"
                found = "none" if value is None else f"a {type(value).__name__}, {value.dtype} {list(value.shape)}"
                raise ObservationError(f"observation {key!r} must be a Tensor, {expected}; found {found}.")
            normalizer = self.kept(f"normalizer {key}")
            given[key] = (value * normalizer["scale"] + normalizer["offset"]).float() if normalizer else value
        return PlainNetwork(self, given, len(initial))

    def _is_far(self, network: PlainNetwork) -> Tensor:
        """Which streams are so far outside of what was recorded that they have no correction, bool ``[B]``."""
        envelope = self.kept("envelope")
        away = network.condition(self._features) @ envelope["reading"] - envelope["center"]
        far: Tensor = torch.linalg.vector_norm(away, dim=1) > FAR
        return far

    def _moves(
        self, network: PlainNetwork, initial: Tensor, steps: Tensor | None, corrected: bool = True
    ) -> tuple[Advance, Tensor, Tensor | None]:
        """The sampler; what each step adds, ``[K, D, B, (1 + S) T]``; and what the correction reads, ``[B, F]``."""
        advance = self._advance.on(self.kept("advance"))
        if not corrected:
            assert self._far is not None
            advance = self._far.on(self.kept("far"))
        spec = self.spec
        horizon, dimensions = spec.sample
        own = self.kept("offset")
        bias = own["bias"] if corrected else torch.zeros_like(own["bias"])
        offset = bias.expand(spec.sampler.steps, dimensions, len(initial), horizon)
        if spec.sampler.stochastic:
            if steps is None or tuple(steps.shape) != (spec.sampler.steps, *initial.shape):
                found = "none" if steps is None else str(list(steps.shape))
                expected = f"float32 [K, B, T, D] = {[spec.sampler.steps, *initial.shape]}"
                raise ObservationError(f"steps must be {expected}, since the sampler draws noise; found {found}.")
            offset = offset + steps.permute(0, 3, 1, 2) * own["noise"]
        read = None
        if advance.reading is not None:
            read, added = advance.of_condition(network.condition(self._features))
            offset = offset + added
        return advance, nn.functional.pad(offset, (0, advance.memories * horizon)), read

    def _actions(self, sample: Tensor, obs: Tensors) -> Tensor:
        """The actions of a denoised sample ``[B, T, D]``, in their own units; of these observations, as given."""
        if self._bound is not None:
            sample = sample.clamp(-self._bound, self._bound)
        chunk, normalizer = self.spec.chunk, self.kept("actions")
        own = sample[..., : chunk.action_dim]
        actions = (own - normalizer["offset"]) / normalizer["scale"] if normalizer else own.clone()
        if (relative := chunk.relative) is not None:
            seen = obs[relative.key]
            newest = nn.functional.pad(seen.reshape(len(seen), -1, seen.shape[-1])[:, -1:], (0, 1))
            actions = relative.absolute(actions, newest[..., relative.places(seen.shape[-1])], torch)
        for one in chunk.switches:
            value = torch.where(own[..., [one.channel]] >= one.threshold, one.above, one.below)
            at = torch.arange(chunk.action_dim, device=own.device) == one.channel
            actions = torch.where(at, value, actions)
        return actions

    def _keep(self, kind: str, arrays: Mapping[str, object]) -> None:
        for name, value in arrays.items():
            buffer = f"constant_{len(self._names)}"  # names of weights have dots
            self._names[f"{kind}/{name}"] = buffer
            self.register_buffer(buffer, value if isinstance(value, Tensor) else torch.tensor(np.asarray(value)))

    def kept(self, kind: str) -> dict[str, Tensor]:
        """Constants of a kind, by name."""
        start = f"{kind}/"
        found = {n.removeprefix(start): b for n, b in self._names.items() if n.startswith(start)}
        return {name: self.get_buffer(buffer) for name, buffer in found.items()}


def _numbers(normalizer: Affine | None) -> dict[str, object]:
    return {} if normalizer is None else {"scale": normalizer.scale, "offset": normalizer.offset}
