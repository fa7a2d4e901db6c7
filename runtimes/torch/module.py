"""The sparse call as a module of torch: for ``torch.export``, AOTInductor, and whoever has a pipeline of torch's.

It is the loop of the runtime (``loop``) around the literal graphs (``ir.evaluate``), whose operations a compiler fuses
as it likes. The plan is fixed when the module is made, so that what is exported is one straight line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import Source, check_plan, require_legal
from ttscompile.core.spec import Affine, PolicySpec
from ttscompile.errors import IllegalPlanError, ObservationError
from ttscompile.ir.evaluate import Evaluator
from ttscompile.ir.graph import Graph, TensorType
from ttscompile.ir.idle_form import idle_form
from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Binding, frame_values
from ttscompile.runtimes.instructions import Instructions, instructions_of

from .idle_steps import IdleSteps
from .loop import denoise
from .sampler import Advance

CPU = torch.device("cpu")


def to_module(path: str | Path, plan: str | None = None) -> SparseCall:
    """The call of a compiled policy with one of its plans, as a module that can be exported.

    Args:
        path: the directory that ``convert`` wrote, or the same zipped.
        plan: ``dense`` or the name of a schedule of the artifact; None for its default plan.

    Returns:
        On the CPU, in fp32, and in evaluation mode; ``to`` moves it. See ``SparseCall.forward``.

    Raises:
        ArtifactError: the artifact is missing, damaged or of another version, or has no schedule of this name.
        IllegalPlanError: the plan is the pruner's, which is decided at test time; or it reads the rollout cache, which
            lives from call to call.
    """
    artifact = load_artifact(path)
    name = artifact.manifest.default_plan if plan is None else plan
    if artifact.plan(name).pruned:
        known = [one for one, each in artifact.plans.items() if not each.pruned]
        problem = f"plan {name!r} is the pruner's, which decides for each observation; a module has one plan"
        raise IllegalPlanError(f"{problem}. Give a schedule, one of {known}, or use load(..., runtime='torch').")
    with artifact.reading():
        return SparseCall(artifact, name).eval()


class SparseCall(nn.Module):
    """One call of a policy with one schedule.

    Every constant is a buffer; there are no parameters, and nothing is kept from call to call.

    Args:
        artifact: loaded and checked.
        plan: ``dense`` or the name of a schedule.

    Raises:
        ArtifactError: there is no such schedule.
        IllegalPlanError: it reads the rollout cache.
    """

    def __init__(self, artifact: Artifact, plan: str) -> None:
        super().__init__()
        own = artifact.plan(plan).exact
        view = view_of(artifact, own)
        manifest, pieces = view.manifest, view.pieces
        self._spec, self._pieces, self._features = manifest.spec, pieces, manifest.features
        groups = manifest.groups
        assert own.cells is not None
        schedule = check_plan(own.cells, manifest.steps, len(groups), 1)
        if (schedule == Source.ROLLOUT).any():
            problem = f"plan {plan!r} reads residuals of earlier calls, and a module keeps nothing between calls"
            raise IllegalPlanError(f"{problem}. Give another plan, or use load(..., runtime='torch').")
        require_legal(schedule, groups, np.zeros(schedule.shape, np.bool_))
        self._plan: Instructions = instructions_of(schedule[0], groups)
        self._names: dict[str, str] = {}  # of buffers, by what they hold
        constants = {name for graph in pieces.graphs().values() for name in graph.constants}
        self._keep("weight", {name: value for name, value in view.weights.items() if name in constants})
        self._keep("first weight", view.first_weights)
        self._keep("table", pieces.tables)
        correction = own.correction
        self._advance = Advance(manifest.spec, correction, CPU)
        self._bound = None if correction is None else manifest.spec.sampler.bound
        self._keep("advance", self._advance.tensors())
        form, _ = idle_form(pieces, view.weights)
        self._idle = None if form is None else IdleSteps(form, CPU)
        self._keep("idle", {} if self._idle is None else self._idle.tensors())
        bias = np.zeros((1, 1, 1, 1), np.float32) if correction is None else correction.bias
        self._keep("offset", {"noise": manifest.spec.sampler.noise_to_next[:, None, None, None], "bias": bias})
        for key, each in manifest.spec.observations.items():
            self._keep(f"normalizer {key}", _numbers(each.normalizer))
        self._keep("actions", _numbers(manifest.spec.chunk.normalizer))
        self._evaluators = {name: _of_values(graph) for name, graph in pieces.graphs().items()}

    @property
    def spec(self) -> PolicySpec:
        """What goes in and comes out."""
        return self._spec

    def forward(self, obs: Mapping[str, Tensor], initial: Tensor, steps: Tensor | None = None) -> Tensor:
        """One call.

        Args:
            obs: observations by key, ``[B, ...]`` each, not normalised: as ``predict_action`` takes them.
            initial: the noise that the sample starts from, float32 ``[B, T, D]``.
            steps: noise of the steps, float32 ``[K, B, T, D]``; needed if the sampler draws noise, else not looked at.

        Returns:
            The actions of all predicted steps, float32 ``[B, T, Da]``, in their own units (``action_pred``).

        Raises:
            ObservationError: an observation or noise of another shape or dtype, or missing.
        """
        spec = self._spec
        horizon, dimensions = spec.sample
        if initial.ndim != 3 or tuple(initial.shape[1:]) != spec.sample or initial.dtype != torch.float32:
            found = f"{initial.dtype} {list(initial.shape)}"
            raise ObservationError(f"initial must be float32 [B, T, D] = [B, {horizon}, {dimensions}]; found {found}.")
        given = {}
        for key, one in spec.observations.items():
            value = obs.get(key)
            shape = None if value is None else tuple(value.shape)
            if value is None or shape != (len(initial), *one.shape) or value.dtype != getattr(torch, one.dtype):
                expected = f"{one.dtype} [{', '.join(map(str, (len(initial), *one.shape)))}]"
                found = "none" if value is None else f"{value.dtype} {list(value.shape)}"
                raise ObservationError(f"observation {key!r} must be {expected}; found {found}.")
            given[key] = _affine(value, self._kept(f"normalizer {key}"))
        network = _Exported(self, given, len(initial))
        own = self._kept("offset")
        offset = own["bias"].expand(spec.sampler.steps, dimensions, len(initial), horizon)
        if spec.sampler.stochastic:
            if steps is None or tuple(steps.shape) != (spec.sampler.steps, *initial.shape):
                found = "none" if steps is None else str(list(steps.shape))
                expected = f"float32 [K, B, T, D] = {[spec.sampler.steps, *initial.shape]}"
                raise ObservationError(f"steps must be {expected}, since the sampler draws noise; found {found}.")
            offset = offset + steps.permute(0, 3, 1, 2) * own["noise"]
        advance = self._advance.on(self._kept("advance"))
        read = None
        if advance.reading is not None:
            read, added = advance.of_condition(network.condition(self._features))
            offset = offset + added
        offset = nn.functional.pad(offset, (0, advance.memories * horizon))
        nothing = np.zeros(self._plan.computed.shape, np.bool_)
        sample = denoise(network, self._plan, nothing, advance, initial, offset.unbind(), {}, read).sample
        if self._bound is not None:
            sample = sample.clamp(-self._bound, self._bound)
        actions = sample[..., : spec.chunk.action_dim]
        normalizer = self._kept("actions")
        return (actions - normalizer["offset"]) / normalizer["scale"] if normalizer else actions.clone()

    def _keep(self, kind: str, arrays: Mapping[str, object]) -> None:
        """Make buffers of arrays or tensors."""
        for name, value in arrays.items():
            buffer = f"constant_{len(self._names)}"  # names of weights have dots
            self._names[f"{kind}/{name}"] = buffer
            self.register_buffer(buffer, value if isinstance(value, Tensor) else torch.tensor(np.asarray(value)))

    def _kept(self, kind: str) -> dict[str, Tensor]:
        """The buffers of a kind, by name."""
        start = f"{kind}/"
        found = {n.removeprefix(start): b for n, b in self._names.items() if n.startswith(start)}
        return {name: self.get_buffer(buffer) for name, buffer in found.items()}


class _Exported:
    """``loop.Network`` of one call, in operations that a compiler sees as they are."""

    def __init__(self, module: SparseCall, obs: Mapping[str, Tensor], streams: int) -> None:
        self._pieces, self._streams, self._evaluators = module._pieces, streams, module._evaluators
        self._weights, self._tables = module._kept("weight"), module._kept("table")
        self._first = self._weights | module._kept("first weight")
        self.idle = None if module._idle is None else module._idle.on(module._kept("idle"))
        seen = frame_values(self._pieces, lambda n, given: self._evaluators[n]({**self._weights, **given}), obs)
        made = self._evaluators["condition"]({**self._weights, **obs, **seen})
        self._condition = dict(zip(self._pieces.condition.outputs, made, strict=True))
        self._by_step: dict[int, dict[str, Tensor]] = {}  # step values, of steps that read them

    def condition(self, features: tuple[str, ...]) -> Tensor:
        """What a correction reads, ``[B, N]``."""
        types = self._pieces.condition.types()
        rows = [self._condition[name].movedim(types[name].batch_axis or 0, 0) for name in features]
        return torch.cat([row.reshape(self._streams, -1) for row in rows], 1)

    def stem(self, sample: Tensor, k: int) -> Tensor:
        """See ``loop.Network``."""
        return self._run("stem", self._pieces.stem, sample, k)

    def block(self, b: int, k: int, stream: Tensor) -> Tensor:
        """See ``loop.Network``."""
        return self._run(list(self._pieces.loop)[1 + b], self._pieces.blocks[b], stream, k)

    def tail(self, stream: Tensor, k: int) -> Tensor:
        """See ``loop.Network``."""
        return self._run("tail", self._pieces.tail, stream, k)

    def _run(self, name: str, piece: LoopPiece, value: Tensor, k: int) -> Tensor:
        reads = {context: self._context(context, k) for context in piece.contexts}
        weights = self._weights if k else self._first
        result: Tensor = self._evaluators[name]({**weights, piece.stream: value, **reads})[0]
        return result

    def _context(self, name: str, k: int) -> Tensor:
        binding = self._pieces.bindings[name]
        if binding is Binding.CONDITION:
            return self._condition[name]
        if binding is Binding.STEP:
            return self._step(k)[name]
        kinds: list[Mapping[str, TensorType]] = [piece.contexts for piece in self._pieces.loop.values()]
        kinds += [] if self._pieces.step is None else [self._pieces.step.inputs]
        axis = next(types[name] for types in kinds if name in types).batch_axis
        row = self._tables[name][k]
        return row.expand([self._streams if i == axis else n for i, n in enumerate(row.shape)])

    def _step(self, k: int) -> dict[str, Tensor]:
        """The step values of step k."""
        step = self._pieces.step
        assert step is not None
        if k not in self._by_step:
            reads = {name: self._context(name, k) for name in step.inputs}
            made = self._evaluators["step"]({**self._weights, **reads})
            self._by_step[k] = dict(zip(step.outputs, made, strict=True))
        return self._by_step[k]


def _of_values(graph: Graph) -> Evaluator:
    """A graph whose constants are inputs: they are buffers, which an exporter puts others in the place of."""
    return Evaluator(replace(graph, inputs={**graph.inputs, **graph.constants}, constants={}), {})


def _numbers(normalizer: Affine | None) -> dict[str, object]:
    return {} if normalizer is None else {"scale": normalizer.scale, "offset": normalizer.offset}


def _affine(value: Tensor, normalizer: Mapping[str, Tensor]) -> Tensor:
    return value * normalizer["scale"] + normalizer["offset"] if normalizer else value
