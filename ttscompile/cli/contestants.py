"""What ``ttscompile bench`` times: plans of artifacts in several ways, and the original network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.manifest import DENSE, marked
from ttscompile.core.spec import FP32, Affine, Noise, PolicySpec
from ttscompile.errors import RuntimeUnavailableError, SpecError
from ttscompile.report.timing import Contestant, plan_contestant
from ttscompile.runtimes.liveness import reading_earlier_calls
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy, require_plan
from ttscompile.runtimes.random_calls import Observation, normalized

if TYPE_CHECKING:
    from torch import nn

    from ttscompile.artifact.manifest import Manifest
    from ttscompile.frontends.eager import EagerPolicy


@dataclass(frozen=True)
class Way:
    """How a compiled policy runs.

    Attributes:
        runtime: ``onnxruntime`` or ``torch``.
        device: that torch computes on; None for the CPU.
        precision: of the weights; None for the runtime's own, see ``runtimes.load.load``.
        threads: that it computes with.
    """

    runtime: str = "onnxruntime"
    device: str | None = None
    precision: str | None = None
    threads: int = 1

    @property
    def place(self) -> str:
        """What computes, for people."""
        return self.runtime + f" on {self.device}" * (self.device is not None)

    def open(self, artifact: Artifact) -> CompiledPolicy:
        """A policy of the artifact that runs so."""
        return open_policy(artifact, self.runtime, self.threads, precision=self.precision, device=self.device)


def contestants(artifacts: Mapping[str, Artifact], plans: Sequence[str], ways: Sequence[Way]) -> list[Contestant]:
    """Plans of artifacts, each in every way; first the dense plan of the first artifact, in fp32.

    Every second plan shares a policy: what one reads is not in the processor's caches for the next, and there are no
    more than two copies of the weights. A plan that reads what an earlier call left there has a policy of its own.

    Args:
        artifacts: by name.
        plans: of the first artifact, and of the others where they have one of this name; all where none is named.
        ways: how they run.

    Raises:
        ArtifactError: one cannot be run.
        IllegalPlanError: the first has no plan of this name.
        RuntimeUnavailableError: a runtime, device or precision cannot be had.
    """
    for plan in plans:
        require_plan(next(iter(artifacts.values())), plan)
    made: list[Contestant] = []

    def enter(series: str, policy: CompiledPolicy, plan: str, way: Way) -> None:
        policy.reset()
        label = [f"{series}: " * (len(artifacts) > 1) + marked(plan)]
        if any(one.place != Way().place for one in ways):
            label.append(way.place)
        if len({one.threads for one in ways}) > 1:
            label.append(f"{way.threads} thread{'s' * (way.threads > 1)}")
        if policy.info.precision != FP32:
            label.append(policy.info.precision)
        one = plan_contestant(", ".join(label), policy, plan, artifacts[series].manifest.spec)
        made.append(replace(one, threads=way.threads))

    for series, artifact in artifacts.items():
        known, reading = (DENSE, *artifact.manifest.plans), reading_earlier_calls(artifact)
        for way in ways:
            shared, wanted = way.open(artifact), [name for name in dict.fromkeys(plans or known) if name in known]
            if not made and shared.info.precision != FP32:
                enter(series, replace(way, precision=FP32).open(artifact), DENSE, way)
            elif not made:
                wanted = list(dict.fromkeys((DENSE, *wanted)))
            pair = [shared, way.open(artifact)] if len(wanted) > 1 else [shared]
            for plan in wanted:
                enter(series, way.open(artifact) if plan in reading else pair[len(made) % len(pair)], plan, way)
    return made


def originals(checkpoint: Path, encoders: Path | None, threads: int, manifest: Manifest) -> list[Contestant]:
    """The network in eager PyTorch, in the loop it was saved with, and in the artifact's where that is another.

    Args:
        checkpoint: as ``convert`` took it.
        encoders: the folder that ``convert`` was given with it, if it was.
        threads: of PyTorch.
        manifest: of the artifact.

    Raises:
        RuntimeUnavailableError: there is no torch.
        SpecError: the checkpoint is of another policy.
    """
    try:
        import torch

        from ttscompile.frontends.eager import eager_policy
        from ttscompile.frontends.encoded import parts
    except ModuleNotFoundError as error:
        raise RuntimeUnavailableError(
            f"the original network needs {error.name}, which is not installed. Run: pip install 'ttscompile[compile]',"
            " or leave --checkpoint out."
        ) from error
    module, saved = original_policy(checkpoint, manifest.spec, encoders)
    torch.set_num_threads(threads)
    dense, own, sampler = manifest.flops.dense, manifest.spec.original, saved.sampler
    # An encoder runs once a call, whatever the sampler: what it takes is not known apart.
    flops = dense / manifest.steps * sampler.steps if parts(module).encoder is None else None
    made = [network_contestant(f"original, {sampler.name} {sampler.steps}", eager_policy(module, saved), saved, flops)]
    if own.sampler.name != sampler.name or not np.array_equal(own.sampler.timesteps, sampler.timesteps):
        label = f"original, {own.sampler.name} {own.sampler.steps}"
        made.append(network_contestant(label, eager_policy(module, own), own, dense))
    return made


def original_policy(checkpoint: Path, spec: PolicySpec, encoders: Path | None = None) -> tuple[nn.Module, PolicySpec]:
    """The network of the checkpoint that an artifact was made from, and what the checkpoint says about it; needs torch.

    Args:
        checkpoint: as ``convert`` took it.
        spec: specification of the policy in the artifact.
        encoders: see ``originals``.

    Raises:
        SpecError: the checkpoint is of another policy.
    """
    from ttscompile.frontends import load_checkpoint_policy
    from ttscompile.frontends.families import as_converted

    module, original = load_checkpoint_policy(checkpoint, options=as_converted(spec.source, encoders))
    wrong = f"{checkpoint}: expected the policy that the artifact was made from"
    found, expected = _interface(original), _interface(spec)
    if found != expected:
        raise SpecError(f"{wrong}, {expected}; found {found}. Give that policy's checkpoint.")
    if different := ", ".join(_different_statistics(original, spec)):
        told = f"found another one of the same shapes: the normaliser of {different} differs"
        raise SpecError(f"{wrong}; {told}. Give that policy's checkpoint.")
    return module, original


def network_contestant(label: str, run: EagerPolicy, spec: PolicySpec, dense_flops: float | None) -> Contestant:
    """The whole network in PyTorch, once a step; ``dense_flops`` as in ``Contestant``."""
    import torch

    def call(obs: Observation, noise: Noise) -> object:
        return run({key: torch.from_numpy(array) for key, array in normalized(spec, obs).items()}, noise)

    return Contestant(label, "dense", call, lambda: None, spec, dense_flops)


def _interface(spec: PolicySpec) -> str:
    observations = ", ".join(f"{key} {observation.shape}" for key, observation in spec.observations.items())
    return f"sample {spec.original.sample}, observations {observations}"


def _different_statistics(found: PolicySpec, expected: PolicySpec) -> list[str]:
    """What is normalised with other numbers: the statistics of the training data tell policies of one task apart."""
    pairs = {
        f"observation {k!r}": (o.normalizer, expected.observations[k].normalizer) for k, o in found.observations.items()
    }
    pairs["the action"] = (found.chunk.normalizer, expected.chunk.normalizer)
    return [name for name, (left, right) in pairs.items() if not _same(left, right)]


def _same(left: Affine | None, right: Affine | None) -> bool:
    if left is None or right is None:
        return left is right
    return np.array_equal(left.scale, right.scale) and np.array_equal(left.offset, right.offset)
