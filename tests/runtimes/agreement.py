"""Run two runtimes side by side over episodes of random legal plans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.rounding import Counted
from ttscompile import Noise
from ttscompile.artifact import Artifact
from ttscompile.core.lattice import Source
from ttscompile.core.plan import Plan
from ttscompile.runtimes import Runtime, open_runtime

from .plans import random_plan

Observation = dict[str, np.ndarray]


def random_inputs(artifact: Artifact, rng: np.random.Generator, streams: int) -> tuple[Observation, Noise]:
    """Normalised observation and noise of one call."""
    spec = artifact.manifest.spec
    shape = (streams, *spec.sample)
    obs = {
        key: rng.standard_normal((streams, *o.shape)).astype(o.dtype)
        if o.bounds is None
        else np.concatenate([o.draw(rng) for _ in range(streams)])
        for key, o in spec.observations.items()
    }
    initial = rng.standard_normal(shape, dtype=np.float32)
    return obs, Noise(initial, rng.standard_normal((spec.sampler.steps, *shape), dtype=np.float32))


def call_terms(artifact: Artifact) -> int:
    """Terms of a dense call of one stream, for ``tests.rounding.bound``; a sparse call has no more."""
    spec, manifest = artifact.manifest.spec, artifact.manifest
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 1)
    runtime = open_runtime(artifact, "reference")
    with Counted() as counted:
        runtime.predict(obs, noise, Plan(cells=np.zeros((spec.sampler.steps, len(manifest.groups)), np.int8)))
    return counted.terms


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
