"""Make the golden record of an artifact: run the original network, and later the plans, on inputs that are kept.

``ttscompile.artifact.golden`` says what is kept and how; ``ttscompile.verification`` compares with it.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from ..artifact.golden import DIGITS, Golden, GoldenPlan, expand, is_sparse, load_golden, pattern, probe_stream, project
from ..artifact.load import Artifact
from ..artifact.view import View, view_of
from ..core.coercion import Array, Arrays
from ..core.plan import Plan
from ..core.spec import ORIGINAL, FloatArray, Noise, PolicySpec
from ..errors import CaptureError
from ..frontends.eager import eager_policy
from ..frontends.encoded import parts, sharing_copy
from ..ir.dataflow import reachable_from, read_from_outside
from ..ir.evaluate import evaluator
from ..ir.graph import Graph, backward_slice
from ..ir.layers import layers
from ..ir.program import Block, Program
from ..ir.rows import Rows
from ..runtimes.plans import pruner_plan, repair_plan
from ..runtimes.reference.model import ReferenceModel, noise_tensors

STREAMS = 2
"""Streams of the call, so that what mixes streams up shows; one where that would take long or much room."""

EVALUATIONS = 6
"""Steps at which inputs and outputs of the network are kept."""

EFFORT = 4e10
"""FLOPs of one call of one stream above which there is one stream, and residuals of fewer steps: Push-T has 16e9."""

ROOM = 1 << 20
"""Bytes of noise of one stream above which there is one stream."""

PROBE = "probe."
"""Before the number of a block: the input that takes the place of the residual stream before it."""


def record_original(module: nn.Module, program: Program) -> Golden:
    """Run the original module, a whole call and single evaluations, and the captured graph block by block; every loop.

    On one thread: the record does not depend on how many there are, nor on what else the machine does. Of what became
    of the module, the pieces are not used.

    Raises:
        CaptureError: the module gives values that are not finite.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        recorder = _Recorder(module, program)
        original = recorder.record(ORIGINAL)
        return replace(original, loops={name: recorder.record(name, original.scales) for name in program.spec.loops})
    finally:
        torch.set_num_threads(threads)


class _Recorder:
    """Runs one loop after the other, with the same observations and the same initial noise."""

    def __init__(self, module: nn.Module, program: Program) -> None:
        spec = program.spec
        small = program.dense_flops <= EFFORT and 4 * spec.sampler.steps * np.prod(spec.sample) <= ROOM
        streams = STREAMS if small else 1
        # The sequences of numpy's distributions may change with its version: what they give is stored.
        self._draw = np.random.default_rng(7)
        self._observations, self._normalized, self._tensors = {}, {}, {}
        for key, one in spec.observations.items():
            raw = np.concatenate([one.draw(self._draw) for _ in range(streams)])
            whole = expand(pattern(raw, one.shape), one.shape)
            normalized = one.normalized(whole)
            self._observations[key], self._normalized[key] = (pattern(each, one.shape) for each in (whole, normalized))
            self._tensors[key] = torch.from_numpy(normalized)
        self._initial = spec.draw_initial(self._draw, (streams, *spec.whole_horizon.sample))
        self._program, self._module = program, sharing_copy(module)
        uncommitted = {key: torch.from_numpy(count) for key, count in spec.committed(streams).items()}
        self._inside = _Inside(program, self._tensors | uncommitted, streams)

    def record(self, loop: str, scales: FloatArray | None = None) -> Golden:
        """The record of a loop; ``scales`` are taken from its middle if they are not given."""
        program = self._program.in_loop(loop)
        spec, kept, timesteps = program.spec, program.spec.sample[0], program.spec.sampler.timesteps
        steps, initial, draws = spec.sampler.steps, self._initial, None
        if spec.sampler.stochastic:
            draws = self._draw.standard_normal((steps, *initial.shape), dtype=np.float32)
        sample, given, predicted = self._run((program.unmoved or spec).whole_horizon, Noise(initial, draws))
        if program.unmoved is not None:
            predicted = predicted - given
        # What the artifact predicts of it: the original has all steps, and says what those that are kept should be.
        initial, sample, given, predicted = (each[..., :kept, :] for each in (initial, sample, given, predicted))
        draws = None if draws is None else draws[..., :kept, :]
        if not (np.isfinite(predicted).all() and np.isfinite(sample).all()):
            found = "the module's prediction on a random observation within the range of its normaliser is not a number"
            raise CaptureError(f"{found}. Look for NaN in its weights, and check normaliser and sampler.")
        seen = {key: expand(stored, spec.observations[key].shape) for key, stored in self._observations.items()}
        actions, flops = spec.chunk.unnormalized(sample, spec.chunk.reference(seen)), program.dense_flops
        evaluated = _spread(steps, EVALUATIONS)
        anchors = _spread(steps, steps if flops <= EFFORT else max(3, int(steps * EFFORT / flops)))
        if scales is None:
            scales = self._inside.scales(given[steps // 2], timesteps[steps // 2])
        residuals, _ = self._inside.alone(timesteps[anchors], scales)
        _, layers = self._inside.alone(timesteps[evaluated], scales)
        return Golden(
            observations=self._observations,
            normalized=self._normalized,
            initial=initial,
            draws=draws,
            steps=anchors,
            scales=scales,
            residuals=residuals,
            layers=layers if layers.size else None,
            evaluated=evaluated,
            inputs=given[evaluated],
            outputs=predicted[evaluated],
            predictions=np.stack([project(one, 0) for one in predicted]),
            path=np.stack([project(one, 0) for one in (*given[1:], sample)]),
            sample=sample,
            actions=actions,
            executed=spec.chunk.executed(actions),
        )

    def _run(self, spec: PolicySpec, noise: Noise) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The denoised sample of a call ``[B, T, D]``; and what the network was given and gave, ``[K, B, T, D]``."""
        evaluations: list[tuple[FloatArray, FloatArray]] = []

        def watch(_: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], output: torch.Tensor) -> None:
            given = args[0] if args else kwargs[spec.sample_argument]
            evaluations.append((given.numpy().copy(), output.numpy().copy()))

        hook = parts(self._module).denoiser.register_forward_hook(watch, with_kwargs=True)
        try:
            sample = eager_policy(self._module, spec)(self._tensors, noise).numpy()
        finally:
            hook.remove()
        given, predicted = (np.stack(each) for each in zip(*evaluations, strict=True))
        return sample, given, predicted


def record_plans(artifact: Artifact) -> dict[str, GoldenPlan]:
    """What the reference runtime makes of the plans of an artifact, with their corrections: two calls each, in fp32.

    Nothing of an artifact without a golden record of the original network.
    """
    if artifact.manifest.stores.golden is None:
        return {}
    golden, found = load_golden(artifact), dict[str, GoldenPlan]()
    obs = golden.network_observations(artifact.manifest.spec)
    plans = {name: artifact.plans[name].exact for name, one in artifact.manifest.plans.items() if is_sparse(one)}
    for variant in dict.fromkeys(plan.variant for plan in plans.values()):
        own = {name: plan for name, plan in plans.items() if plan.variant == variant}
        view = view_of(artifact, next(iter(own.values())))
        model = ReferenceModel.from_view(view)  # one at a time: each holds all weights
        record = golden.in_loop(artifact.manifest.whole_loop(variant.loop))
        with torch.no_grad():
            found |= {name: _episode(view, model, plan, record, obs) for name, plan in own.items()}
    return {name: found[name] for name in plans}


def _episode(view: View, model: ReferenceModel, plan: Plan, golden: Golden, obs: Arrays) -> GoldenPlan:
    cache, calls, chunk = model.empty_cache(golden.streams), [], golden.sample
    for order in (1, -1):
        contexts = model.prologue({key: torch.from_numpy(value[::order].copy()) for key, value in obs.items()})
        wanted = pruner_plan(model.logits(contexts).numpy()) if plan.cells is None else plan.cells
        cells, _ = repair_plan(wanted, cache.written)
        noise = Noise(golden.initial[::order], None if golden.draws is None else golden.draws[:, ::order])
        if view.start is not None:
            reference = view.manifest.spec.reference(obs)
            change = None if reference is None else (reference, reference[::order])
            noise = view.start.noise_from(chunk, view.manifest.spec.chunk, noise, change=change)
        inputs = noise_tensors(noise, view.manifest.spec.sampler.stochastic)
        result = model.denoise(contexts, *inputs, cells, cache, correction=plan.correction)
        cache, chunk = result.cache, result.sample.numpy()
        path = np.stack([project(sample.numpy(), 0) for sample in result.samples])
        calls.append((cells, path, chunk))
    return GoldenPlan(*(np.stack(each) for each in zip(*calls, strict=True)))


def _spread(steps: int, count: int) -> npt.NDArray[np.int64]:
    """Numbers of ``count`` steps, evenly spread, the first and the last among them; all if there are no more."""
    return np.unique(np.linspace(0, steps - 1, min(count, steps)).round().astype(np.int64))


class _Inside:
    """The captured graph of one evaluation on normalised observations ``[B, ...]``, cut open at its residual stream."""

    def __init__(self, program: Program, observations: Mapping[str, torch.Tensor], streams: int) -> None:
        self._spec, self._blocks, self._streams = program.spec, program.blocks, streams
        self._weights = program.weights
        self._observations = dict(observations)
        whole = program.denoiser
        self._closed = replace(whole, outputs=tuple(block.stream for block in self._blocks))
        opened = _opened(whole, self._blocks)
        self._open = replace(opened, outputs=(*opened.outputs, *layers(program).values()))
        self._condition, self._loop = _split(self._open, [program.spec.sample_argument, program.spec.timestep_argument])

    def scales(self, sample: FloatArray, timestep: np.generic) -> FloatArray:
        """Standard deviation of the residual stream before each block, for this sample at this timestep."""
        inputs = {self._spec.sample_argument: torch.from_numpy(sample), **self._at(timestep)}
        with torch.inference_mode():
            streams = evaluator(self._closed, self._weights)(inputs)
        return np.array([max(float(stream.std()), 1e-3) for stream in streams], np.float32)

    def alone(self, timesteps: Array, scales: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What each block, and each layer, gives on ``probe_stream`` at these A timesteps.

        Projections of residuals ``[A, blocks, B, DIGITS]``, and of layers ``[A, L, DIGITS]``.
        """
        probes = [
            torch.from_numpy(probe_stream(block.index, block.type, self._streams, float(scale)))
            for block, scale in zip(self._blocks, scales, strict=True)
        ]
        run = evaluator(self._loop, self._weights)
        with torch.inference_mode():
            values = evaluator(self._condition, self._weights)(self._observations)
        fixed = dict(zip(self._condition.outputs, values, strict=True))
        given = dict(zip(list(self._open.inputs)[-len(probes) :], probes, strict=True))
        blocks, layers = len(self._blocks), len(self._open.outputs) - len(self._blocks)
        found = np.zeros((len(timesteps), blocks, self._streams, DIGITS), np.float32)
        inside = np.zeros((len(timesteps), layers, DIGITS), np.float32)
        for i, timestep in enumerate(timesteps):
            with torch.inference_mode():
                results = run({**fixed, **given, **self._at(timestep)})
            for b, (block, result) in enumerate(zip(self._blocks, results[:blocks], strict=True)):
                residual = result if block.residual is not None else result - probes[b]
                found[i, b] = project(residual.numpy(), block.type.batch_axis)
            for layer, result in enumerate(results[blocks:]):
                (inside[i, layer],) = project(result.numpy(), None)
        return found, inside

    def _at(self, timestep: np.generic) -> dict[str, torch.Tensor]:
        timesteps = torch.from_numpy(np.full(self._streams, timestep))
        return {self._spec.timestep_argument: timesteps, **self._observations}


def _opened(graph: Graph, blocks: tuple[Block, ...]) -> Graph:
    """The graph with the residual stream before each block given as an input, and with the residuals as outputs.

    Nothing but block b reads the residual stream before it (``find_residual_blocks`` sees to that), so that it can be
    replaced wherever it is read.
    """
    places = {block.stream: f"{PROBE}{block.index}" for block in blocks}
    nodes = tuple(node.renamed(lambda name: places.get(name, name)) for node in graph.nodes)
    probes = {places[block.stream]: block.type for block in blocks}
    outputs = tuple(block.result if block.residual is None else block.residual for block in blocks)
    like, inner = blocks[0].type, graph.types()[blocks[0].stream]
    if like == inner:
        return Graph({**graph.inputs, **probes}, graph.constants, nodes, outputs)
    # A doubled batch: the residual stream has an axis of streams between blocks, not inside the graph (``ir.rows``).
    into = [Rows(name, inner, f"{name}.rows", like) for name in probes]
    out = [Rows(name, inner, f"{name}.rows", like) for name in outputs]
    return Graph(
        {**graph.inputs, **{one.crossing: like for one in into}},
        graph.constants,
        (*(one.enter() for one in into), *nodes, *(one.leave() for one in out)),
        tuple(one.crossing for one in out),
    )


def _split(graph: Graph, varying: list[str]) -> tuple[Graph, Graph]:
    """What depends on observations alone, once, and what depends on these inputs or on a probe, for every step."""
    starts = [*varying, *(name for name in graph.inputs if name.startswith(PROBE))]
    read = read_from_outside(graph, reachable_from(graph, starts))
    before = {name: type_ for name, type_ in read.items() if name not in graph.inputs}
    once = backward_slice(graph, tuple(before), {})
    # All observations, read or not: they say how many streams there are.
    once = replace(once, inputs={name: type_ for name, type_ in graph.inputs.items() if name not in starts})
    return once, backward_slice(graph, graph.outputs, before)
