"""Run runtimes side by side over random calls, and episodes of random legal plans."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tests.rounding import FLOAT32, Counted, assert_equal_but_for_rounding
from ttscompile import Noise
from ttscompile.artifact import Artifact
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import Source
from ttscompile.core.plan import Plan
from ttscompile.runtimes import Runtime, open_runtime

from .plans import random_plan

Observation = dict[str, np.ndarray]
RUNTIMES = ("onnxruntime", "torch", "reference")
COUNTED: dict[str, int] = {}
"""What ``call_terms`` has counted, by identity of the model."""


def random_inputs(artifact: Artifact, rng: np.random.Generator, streams: int) -> tuple[Observation, Noise]:
    """Normalised observation and noise of one call."""
    spec = artifact.manifest.spec
    shape = (streams, *spec.sample)
    obs = {
        key: rng.standard_normal((streams, *o.shape)).astype("float32" if o.normalizer else o.dtype)
        if o.bounds is None
        else np.concatenate([o.draw(rng) for _ in range(streams)])
        for key, o in spec.observations.items()
    }
    initial = rng.standard_normal(shape, dtype=np.float32)
    return obs, Noise(initial, rng.standard_normal((spec.sampler.steps, *shape), dtype=np.float32))


def call_terms(artifact: Artifact) -> int:
    """Terms of a dense call of one stream, for ``tests.rounding.bound``; a sparse call has no more."""
    spec, manifest = artifact.manifest.spec, artifact.manifest
    if manifest.model_identity not in COUNTED:
        obs, noise = random_inputs(artifact, np.random.default_rng(0), 1)
        runtime = open_runtime(artifact, "reference")
        with Counted() as counted:
            runtime.predict(obs, noise, Plan(cells=np.zeros((spec.sampler.steps, len(manifest.groups)), np.int8)))
        COUNTED[manifest.model_identity] = counted.terms
    return COUNTED[manifest.model_identity]


def assert_alike(
    artifact: Artifact,
    runtimes: Sequence[Runtime],
    plan: Plan,
    rng: np.random.Generator,
    streams: int = 1,
    *,
    times: float = 1,
    prefix: np.ndarray | None = None,
    unit: float = FLOAT32,
) -> None:
    """Make a random call on two runtimes, on the second in fp32: the samples differ by rounding.

    Args:
        times: so many times the terms of a call are allowed.
    """
    obs, noise = random_inputs(artifact, rng, streams)
    both = zip(runtimes, (plan, plan.exact), strict=True)
    ours, theirs = (runtime.predict(obs, noise, each, prefix)[0] for runtime, each in both)
    assert_equal_but_for_rounding(ours, theirs, times * call_terms(artifact), unit=unit)


def corrected_episode(
    artifact: Artifact,
    rng: np.random.Generator,
    streams: int,
    corrections: Sequence[Correction | None],
    lengths: Sequence[int | None],
) -> Iterator[tuple[list[np.ndarray], np.ndarray | None]]:
    """Samples of random calls, and their prefixes of these lengths: all runtimes agree; the reference's is the last.

    Args:
        corrections: take turns.
    """
    manifest, (horizon, _) = artifact.manifest, artifact.manifest.spec.sample
    runtimes = [open_runtime(artifact, name) for name in RUNTIMES]
    written = np.zeros((streams, manifest.steps, len(manifest.groups)), np.bool_)
    # A correction adds six numbers for each action of the chunk: sample and prediction, now and at two anchors.
    terms = call_terms(artifact) + manifest.steps * 6 * horizon
    for call, length in enumerate(lengths):
        plans = np.stack([random_plan(rng, manifest.steps, manifest.groups, cells) for cells in written])
        obs, noise = random_inputs(artifact, rng, streams)
        shape = streams, length or 0, manifest.spec.chunk.action_dim
        prefix = None if length is None else rng.uniform(-1, 1, shape).astype(np.float32)
        plan = Plan(cells=plans, correction=corrections[call % len(corrections)])
        samples = [runtime.predict(obs, noise, plan, prefix)[0] for runtime in runtimes]
        for each in samples[:-1]:
            assert_equal_but_for_rounding(each, samples[-1], terms)
        yield samples, prefix
        written |= plans == Source.COMPUTE


def each_alone(
    artifact: Artifact, rng: np.random.Generator, streams: int, calls: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Samples of random calls of several streams, of each beside the others and alone, which counts the same."""
    manifest, together = artifact.manifest, open_runtime(artifact)
    apart = [open_runtime(artifact) for _ in range(streams)]
    written = np.zeros((streams, manifest.steps, len(manifest.groups)), np.bool_)
    for _ in range(calls):
        plans = np.stack([random_plan(rng, manifest.steps, manifest.groups, cells) for cells in written])
        obs, noise = random_inputs(artifact, rng, streams)
        assert noise.steps is not None
        sample, report = together.predict(obs, noise, Plan(cells=plans))
        for s, runtime in enumerate(apart):
            one = slice(s, s + 1)
            seen, own = {key: value[one] for key, value in obs.items()}, Noise(noise.initial[one], noise.steps[:, one])
            alone, single = runtime.predict(seen, own, Plan(cells=plans[s]))
            assert single.flops[0] == report.flops[s]
            yield sample[s], alone[0]
        written |= plans == Source.COMPUTE


def largest_difference(
    artifact: Artifact,
    left: Runtime,
    right: Runtime,
    rng: np.random.Generator,
    streams: int,
    calls: int,
    base: Plan | None = None,
) -> float:
    """One episode of random legal plans, one for each stream; differences relative to the sample's largest value.

    ``left`` has them with the other fields of ``base``, and ``right`` with those in fp32.
    """
    base = base or Plan()
    manifest = artifact.manifest
    written = np.zeros((streams, manifest.steps, len(manifest.groups)), np.bool_)
    left.reset()
    right.reset()
    worst = 0.0
    for _ in range(calls):
        computed = rng.uniform(0.02, 0.3)
        plans = np.stack([random_plan(rng, manifest.steps, manifest.groups, cells, computed) for cells in written])
        obs, noise = random_inputs(artifact, rng, streams)
        both = ((left, replace(base, cells=plans)), (right, replace(base, cells=plans).exact))
        samples = [runtime.predict(obs, noise, plan)[0] for runtime, plan in both]
        worst = max(worst, float(np.abs(samples[0] - samples[1]).max() / np.abs(samples[1]).max()))
        written |= plans == Source.COMPUTE
    return worst
