"""Timing of policies that take turns, call by call, on the same observations and noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.core.lattice import Source
from ttscompile.core.spec import FP32, Affine, Noise, PolicySpec
from ttscompile.errors import RuntimeUnavailableError, SpecError
from ttscompile.measure.timer import Timer, Times
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.random_calls import Observation, normalized, random_call

if TYPE_CHECKING:
    from torch import nn

    from ttscompile.artifact.manifest import Manifest
    from ttscompile.frontends.eager import EagerPolicy

WARM_UP = 3
"""Calls of each that are not counted: allocations, and the first call of an episode, which cannot use ROLLOUT."""


@dataclass(frozen=True)
class Contestant:
    """One way to make a call.

    Attributes:
        label: name of the contestant, for people.
        plan: that it runs; for people and the warning about a dense one.
        call: one call, given an observation of one stream and noise.
        report: the report of the last call; None if there is none, and everything was computed.
        spec: specification of the policy.
        dense_flops: of a call without a report; None where they are not known.
    """

    label: str
    plan: str
    call: Callable[[Observation, Noise], object]
    report: Callable[[], Any]
    spec: PolicySpec
    dense_flops: float | None


@dataclass(frozen=True)
class Measurement:
    """What the counted calls of one contestant took.

    Attributes:
        label: name of the contestant, for people.
        plan: name of the plan that it ran.
        times_ms: wall time of each call.
        prologue_ms: median of the report's timing; None without reports.
        pruner_ms: median of the pruner's own time; None without reports.
        frames_ms: median of what depends on single frames alone, which is part of the prologue; None without reports.
        flops: median over the calls; None where they are not known.
        sparsity: mean share of reused cells.
        legalised: cells that had to be replaced because they were never computed, all calls together.
    """

    label: str
    plan: str
    times_ms: tuple[float, ...]
    prologue_ms: float | None = None
    pruner_ms: float | None = None
    frames_ms: float | None = None
    flops: float | None = None
    sparsity: float = 0.0
    legalised: int = 0

    @property
    def median_ms(self) -> float:
        """Median of the times."""
        return Times(self.times_ms).median

    @property
    def quartiles_ms(self) -> tuple[float, float]:
        """First and third quartile of the times."""
        return Times(self.times_ms).quartiles

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self) | {"median_ms": self.median_ms, "quartiles_ms": self.quartiles_ms}


@dataclass(frozen=True)
class Compiled:
    """How the compiled policy runs.

    Attributes:
        runtime: ``onnxruntime`` or ``torch``.
        device: that torch computes on; None for the CPU.
        precision: of the weights; None for the runtime's own, see ``runtimes.load.load``.
        threads: that it, and each of its rivals, computes with.
    """

    runtime: str = "onnxruntime"
    device: str | None = None
    precision: str | None = None
    threads: int = 1


def contestants(
    artifact: Artifact,
    own: Compiled,
    plan: str | None,
    against: Sequence[str],
    checkpoint: Path | None,
    encoders: Path | None = None,
    other_threads: Sequence[int] = (),
) -> list[Contestant]:
    """The compiled policy first, then its rivals, in fp32; each with a policy, and caches, of its own.

    Args:
        artifact: of all that run it.
        own: how the compiled policy runs.
        plan: of the compiled policy; None for the artifact's default.
        against: ``original``, ``eager``, ``onnxruntime-dense``, ``onnxruntime``.
        checkpoint: for ``original`` and ``eager``.
        encoders: the folder that ``convert`` was given with the checkpoint, if it was.
        other_threads: numbers of threads that the compiled policy runs with, too; these come right after the first.

    Raises:
        ArtifactError: it cannot be run.
        RuntimeUnavailableError: ``eager`` without torch; or runtime, device or precision cannot be had.
        SpecError: the checkpoint is of another policy.
    """
    manifest, threads = artifact.manifest, own.threads
    chosen = plan or manifest.default_plan

    def compiled(label: str, plan: str, how: Compiled) -> Contestant:
        policy = open_policy(artifact, how.runtime, how.threads, precision=how.precision, plan=plan, device=how.device)
        policy.reset()
        found = policy.info.precision
        return plan_contestant(label + f", {found}" * (found != FP32), policy, plan, manifest.spec)

    label = "compiled" if own.runtime == "onnxruntime" else _where(own)
    made = [compiled(label, chosen, own)]
    made += [compiled(f"{label}, threads: {n}", chosen, replace(own, threads=n)) for n in other_threads]
    for rival in against:
        if rival == "onnxruntime-dense":
            made.append(compiled("dense onnxruntime", "dense", Compiled(precision=FP32, threads=threads)))
        elif rival == "onnxruntime":
            made.append(compiled("onnxruntime", chosen, Compiled(threads=threads)))
        elif checkpoint is not None:
            made.append(_eager(checkpoint, encoders, threads, manifest, rival == "original"))
    return made


def _where(own: Compiled) -> str:
    return f"compiled, {own.runtime}" + f" on {own.device}" * (own.device is not None)


def measure(
    entered: Sequence[Contestant],
    runs: int,
    seed: int,
    on_round: Callable[[int, int], None] = lambda done, total: None,
    warm_up: int = WARM_UP,
    in_a_row: int = 1,
) -> list[Measurement]:
    """Time the contestants in turn, so that whatever else the machine does hits all of them.

    What the others do in between takes the processor's caches, as a robot's other work does. Of several calls in a row
    the last one finds in them the weights that the one before it read.

    Args:
        entered: at least one; those of one specification get the same observations and noise.
        runs: counted calls of each.
        seed: of observations and noise.
        on_round: told how many rounds of how many are done.
        warm_up: calls of each before these.
        in_a_row: calls that each makes in its turn, of which the last is timed.

    Returns:
        One measurement a contestant.
    """
    timer = Timer(len(entered), warm_up)
    reports: list[list[Any]] = [[] for _ in entered]
    specs = {id(one.spec): one.spec for one in entered}
    for number in range(warm_up + runs):
        # Each call has frames of its own: those that are known would cost a compiled policy nothing.
        numbers = range(number * in_a_row, (number + 1) * in_a_row)
        calls = {name: [random_call(spec, each, seed) for each in numbers] for name, spec in specs.items()}
        for i in timer.round():
            one = entered[i]
            *before, last = (partial(one.call, *each) for each in calls[id(one.spec)])
            for call in before:
                call()
            timer.time(i, last)
            if timer.counted:
                reports[i].append(one.report())
        on_round(number + 1, warm_up + runs)
    return [_summary(*one) for one in zip(entered, timer.times, reports, strict=True)]


def plan_contestant(label: str, policy: CompiledPolicy, plan: str, spec: PolicySpec) -> Contestant:
    """A plan of a loaded policy, which contestants may share if their plans read nothing of earlier calls."""

    def call(obs: Observation, noise: Noise) -> object:
        return policy.predict_action(obs, noise=noise, plan=plan)

    return Contestant(label, plan, call, lambda: policy.last_report, spec, 0.0)


def _eager(checkpoint: Path, encoders: Path | None, threads: int, manifest: Manifest, as_saved: bool) -> Contestant:
    """The original network in eager PyTorch, in the artifact's denoising loop, or in the one it was saved with."""
    try:
        import torch

        from ttscompile.frontends.eager import eager_policy
        from ttscompile.frontends.encoded import parts
    except ModuleNotFoundError as error:
        raise RuntimeUnavailableError(
            f"the original network needs {error.name}, which is not installed. Run: pip install 'ttscompile[compile]',"
            " or take 'original' and 'eager' out of --against."
        ) from error
    module, original = original_policy(checkpoint, manifest.spec, encoders)
    torch.set_num_threads(threads)
    dense, sampler = manifest.flops.dense, original.sampler
    if not as_saved:
        whole = manifest.spec.whole_horizon
        return network_contestant("eager PyTorch", eager_policy(module, whole), whole, dense)
    # An encoder runs once a call, whatever the sampler: what it takes is not known apart.
    flops = dense / manifest.steps * sampler.steps if parts(module).encoder is None else None
    label = f"original, {sampler.name} {sampler.steps}"
    return network_contestant(label, eager_policy(module, original), original, flops)


def original_policy(checkpoint: Path, spec: PolicySpec, encoders: Path | None = None) -> tuple[nn.Module, PolicySpec]:
    """The network of the checkpoint that an artifact was made from, and what the checkpoint says about it; needs torch.

    Args:
        checkpoint: as ``convert`` took it.
        spec: specification of the policy in the artifact.
        encoders: see ``contestants``.

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
    return f"sample {spec.whole_horizon.sample}, observations {observations}"


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


def _summary(contestant: Contestant, times: Times, reports: Sequence[Any]) -> Measurement:
    if reports[0] is None:
        return Measurement(contestant.label, contestant.plan, times.ms, flops=contestant.dense_flops)
    return Measurement(
        label=contestant.label,
        plan=contestant.plan,
        times_ms=times.ms,
        prologue_ms=float(np.median([r.timings.prologue for r in reports])),
        pruner_ms=float(np.median([r.timings.pruner for r in reports])),
        frames_ms=float(np.median([r.timings.frames for r in reports])),
        flops=float(np.median([r.flops[0] for r in reports])),
        sparsity=float(np.mean([np.mean(r.plan != Source.COMPUTE) for r in reports])),
        legalised=sum(sum(r.legalised) for r in reports),
    )
