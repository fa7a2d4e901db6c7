"""What ``ttscompile bench`` times: plans of artifacts, and the original network; and the table and picture of that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.manifest import marked
from ttscompile.artifact.view import view_of
from ttscompile.calibration.progress import Bar
from ttscompile.cli.output import manifest_of, only_results_on_stdout, progress, say, table
from ttscompile.cli.sections import Recordings
from ttscompile.core.envelope import FAR
from ttscompile.core.plan import DENSE
from ttscompile.core.spec import Noise, PolicySpec
from ttscompile.errors import ArtifactChangedError, SpecError, needing
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.units import ms, share
from ttscompile.plots.figure import write_picture
from ttscompile.plots.frontier import plot_calls, plot_frontier
from ttscompile.report.timing import Contestant, plan_contestant
from ttscompile.runtimes.liveness import reads_earlier_calls
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.open import require_able
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.random_calls import Observation, normalized

if TYPE_CHECKING:
    from rich.console import Console
    from torch import nn

    from ttscompile.frontends.eager import EagerPolicy
    from ttscompile.measure.points import Comparison


MOST_DRAWN = 8
"""Plans whose furthest calls are drawn."""
_NO_LIMIT = 1e6  # of a distance; where one episode was held out its interval ends at 1e15 (``measure.points``)


@dataclass(frozen=True)
class Way:
    """How a compiled policy runs."""

    runtime: str = "onnxruntime"
    device: str | None = None
    threads: int = 1

    @property
    def place(self) -> str:
        """What computes, for people."""
        return self.runtime + f" on {self.device}" * (self.device is not None)

    def open(self, artifact: Artifact, plan: str) -> CompiledPolicy:
        """A policy of the artifact that runs so."""
        return open_policy(artifact, self.runtime, self.threads, plan=plan, device=self.device)


def contestants(artifacts: Mapping[str, Artifact], plans: Sequence[str], ways: Sequence[Way]) -> list[Contestant]:
    """Plans of artifacts, each in every way; first the dense plan of the first artifact.

    Every second plan shares a policy: what one reads is not in the processor's caches for the next, and there are no
    more than two copies of the weights. A plan that goes on from an earlier call has a policy of its own.

    Args:
        plans: of the first artifact, and of the others where they have one of this name; all where none is named.
            ``NAME@PRECISION`` is one in another precision.

    Raises:
        ArtifactError: one cannot be run, or has no models of a plan's precision.
        IllegalPlanError: the first has no plan of this name.
        RuntimeUnavailableError: a runtime or device cannot be had, or cannot do what a plan asks for.
    """
    made: list[Contestant] = []

    def enter(series: str, policy: CompiledPolicy, plan: str, way: Way) -> None:
        policy.reset()
        label = [f"{series}: " * (len(artifacts) > 1) + marked(plan)]
        if any(one.place != Way().place for one in ways):
            label.append(way.place)
        if len({one.threads for one in ways}) > 1:
            label.append(f"{way.threads} thread{'s' * (way.threads > 1)}")
        if "@" not in plan:
            label += dict.fromkeys(artifacts[series].plan(plan).precision.values())
        one = plan_contestant(", ".join(label), policy, plan, artifacts[series].manifest.spec)
        made.append(replace(one, threads=way.threads))

    for series, artifact in artifacts.items():
        known = list(artifact.plans)
        if not made:
            known = list(dict.fromkeys(plans or known))
        elif plans:
            known = [name for name in dict.fromkeys(plans) if name.partition("@")[0] in known]
        for way in ways:
            wanted = known if made else list(dict.fromkeys((DENSE, *known)))
            for name in wanted:
                require_able(way.runtime, artifact, artifact.plan(name))
            pair = [way.open(artifact, name) for name in wanted[:2]]
            for name in wanted:
                plan = artifact.plan(name)
                goes_on = plan.otherwise is not None or plan.tokens is not None
                goes_on = goes_on or reads_earlier_calls(view_of(artifact, plan), plan)
                enter(series, way.open(artifact, name) if goes_on else pair[len(made) % len(pair)], name, way)
    return made


def originals(
    checkpoint: Path, encoders: Path | None, threads: int, artifact: Artifact, device: str | None = None
) -> list[Contestant]:
    """The network in eager PyTorch, in the loop it was saved with, and in the default plan's where that is another.

    Args:
        checkpoint: see ``original_policy``, as for ``encoders``.
        threads: of PyTorch.
        device: where PyTorch computes, None for the CPU. Its settings are torch's own: convolutions may use TF32.

    Raises:
        RuntimeUnavailableError: there is no torch, or no such device.
        SpecError: the checkpoint is of another policy.
    """
    with needing("the original network", "compile", ", or leave --checkpoint out"):
        import torch

        from ttscompile.frontends.eager import eager_policy
        from ttscompile.frontends.encoded import parts
        from ttscompile.runtimes.torch.devices import device_of
    module, saved = original_policy(checkpoint, artifact.manifest.spec, encoders)
    torch.set_num_threads(threads)
    module.to(device_of(device or "cpu"))
    manifest, found = artifact.manifest, artifact.default.otherwise or artifact.default
    own = replace(manifest.spec.whole_horizon, sampler=manifest.sampler_of(found.loop), loops={})
    made: list[Contestant] = []
    for spec in (saved, own):
        sampler = spec.sampler
        if made and sampler.name == saved.sampler.name and np.array_equal(sampler.timesteps, saved.sampler.timesteps):
            continue
        # An encoder runs once a call, whatever the sampler: what it takes is not known apart.
        same = sampler.steps == manifest.steps or parts(module).encoder is None
        flops = manifest.flops.dense / manifest.steps * sampler.steps if same else None
        label = f"original, {sampler.name} {sampler.steps}" + f", on {device}" * (device is not None)
        made.append(network_contestant(label, eager_policy(module, spec), spec, flops))
    return made


def original_policy(checkpoint: Path, spec: PolicySpec, encoders: Path | None = None) -> tuple[nn.Module, PolicySpec]:
    """The network of the checkpoint that an artifact was made from, and what the checkpoint says about it; needs torch.

    Args:
        checkpoint: as ``convert`` took it; that of another policy is a SpecError.
        spec: of the policy in the artifact.
        encoders: the folder that ``convert`` was given with the checkpoint, if it was.
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
    numbers = {name: [one and (*one.scale.flat, *one.offset.flat) for one in pair] for name, pair in pairs.items()}
    return [name for name, (left, right) in numbers.items() if left != right]


def compare(
    directory: Path, artifacts: Mapping[str, Artifact], others: Sequence[Path], recordings: Recordings, **how: Any
) -> Comparison:
    """Hold plans against the dense policy on held-out calls, as ``calibration.compare``; warns on standard error."""
    with needing("-t", "compile"):
        from ttscompile.calibration.compare import compare as measure
    with only_results_on_stdout(), Bar(shown=True) as bar:
        found = measure(directory, recordings, others, progress=bar.tell, **how)
    pairs = zip((directory, *others), artifacts.values(), strict=True)
    if changed := [path for path, one in pairs if manifest_of(path).identity != one.manifest.identity]:
        raise ArtifactChangedError(f"{changed[0]}: it was replaced meanwhile. Try again.")
    say(progress(), *(f"warning: {warning}" for warning in found.warnings))
    return found


def draw_comparison(found: Comparison, directory: Path, picture: Path) -> str:
    """Draw it, and beside it the calls that are furthest from the original; says so."""
    title = f"{directory.resolve().name}: {found.calls} held-out calls, {_threads(found)}\n{one_line(fingerprint())}"
    write_picture(plot_frontier(found.points, found.efficient(), title), picture)
    plans = found.points[1 : 1 + MOST_DRAWN] or found.points  # the first is the original
    shown = [(f"{p.series}: {p.name}, {one.told}", one) for p in plans for one in p.furthest]
    write_picture(plot_calls(shown), calls := picture.with_stem(f"{picture.stem}-calls"))
    return f"wrote {picture} and {calls}"


def _threads(found: Comparison) -> str:
    return f"{found.threads} thread{'s' * (found.threads > 1)}"


def print_comparison(found: Comparison, output: Console) -> None:
    """The comparison as a table, and what is compared."""
    efficient = found.efficient()
    scored = ("", "plan", "distance", "95 %", "error", "90th pct.")
    made = table(*scored, "ms a call", "quartiles", "GFLOP", "reused", "frontier")
    for p in found.points:
        made.add_row(
            p.series,
            p.name,
            f"{p.distance:.3f}",
            "..".join(f"{one:.3f}" for one in p.interval) if max(p.interval) < _NO_LIMIT else "unknown",
            "" if p.error is None else f"{p.error:.4g}",
            "" if p.error_p90 is None else f"{p.error_p90:.4g}",
            ms(p.latency_ms, 4),
            "..".join(ms(quartile, 4) for quartile in p.quartiles_ms),
            f"{p.flops / 1e9:.3f}",
            share(p.sparsity),
            "yes" if p in efficient else "",
        )
    output.print(made)
    apart = table("", "plan", "distance by number of the action", "error", "furthest calls", "outside")
    for p in found.points:
        listed = (p.by_number, p.errors, p.outside)
        by_number, errors, outside = (", ".join(f"{one:.3g}" for one in each) for each in listed)
        apart.add_row(p.series, p.name, by_number, errors, "; ".join(one.told for one in p.furthest), outside)
    output.print(apart)
    say(
        output,
        "Distance: between the actions and the original's for the same observation, in units of what other noise"
        f" changes; 0 is the same. {found.calls} observations of episodes that nothing here was learned from, each with"
        " several draws of noise. Error: with the same noise, in the units of the actions, in which two calls of the"
        f" original are {found.other_noise:.4g} apart; another sampler takes other noise, and has none. Latency:"
        f" medians, one stream, {_threads(found)}. Frontier: no other plan is faster and nearer. Outside: within"
        " what distance of what was recorded for calibration half, nine tenths and all of these observations are. The"
        f" furthest that was recorded has 1; above {FAR:g} a call has no correction.",
    )
    say(output, *(f"{name}: left out: {reason}" for name, reason in found.skipped.items()))
