"""What an artifact needs of this machine, tried; what of a checkpoint or of recordings goes wrong without an error.

Imports at need, to say what is missing.
"""

from __future__ import annotations

import statistics
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ttscompile.core.finding import Finding, Level
from ttscompile.errors import NonFiniteActionsError, TtscompileError

from .machine import available_bytes

if TYPE_CHECKING:
    from ttscompile.artifact.load import Artifact
    from ttscompile.core.spec import PolicySpec

PART, CHECKPOINT = "artifact", "checkpoint"
CALLS = 5
_COPIES = 3
"""Times the weights that loading takes at most, for a moment: the mapped file, and onnxruntime's packed copies."""


def artifact_findings(directory: Path) -> list[Finding]:
    """Does it load here, does it fit, and does a call give finite actions, in which time; up to the first problem."""
    try:
        from ttscompile.artifact.load import load_artifact
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        remedy = f"Run: pip install {package}."
        return [Finding(PART, "load", f"not tried: {package} is not installed", Level.PROBLEM, remedy)]
    try:
        artifact = load_artifact(directory)
    except TtscompileError as error:
        return [Finding(PART, "load", str(error), Level.PROBLEM, "As the message says; nothing else was tried.")]
    return [*_needs(artifact), *_call(artifact)]


def _needs(artifact: Artifact) -> list[Finding]:
    from ttscompile.artifact.view import view_of
    from ttscompile.measure.machine import has_integer_dot_product
    from ttscompile.runtimes.liveness import rollout_needs

    manifest, needs = artifact.manifest, artifact.manifest.requires
    written = f"schema {manifest.schema_version} of ttscompile {manifest.ttscompile_version}"
    told = f"{written}; opset {needs.opset}, onnxruntime {needs.onnxruntime} or later"
    found = [Finding(PART, "identity", manifest.short_identity), Finding(PART, "format", told)]
    precision = manifest.precision_name
    slow = precision != "fp32" and has_integer_dot_product() is False
    remedy = "Its fast kernels saturate on this processor. Take plans in fp32, which it holds too: 'NAME@fp32'."
    found.append(Finding.judged(PART, "precision", precision + ", without VNNI or AMX" * slow, slow, remedy))
    weights = artifact.bytes
    cache = rollout_needs(view_of(artifact))
    told = (
        f"{weights / 2**20:.1f} MiB of files, and {cache.bytes_read / 2**20:.1f} MiB of rollout cache a stream for its"
        f" plans ({cache.bytes_most / 2**20:.1f} for plans that you give)"
    )
    available, needed = available_bytes(), _COPIES * weights + cache.bytes_read
    remedy = f"{(available or 0) / 2**20:.0f} MiB are available: free some, or raise the limit of the control group."
    short = available is not None and needed > available
    found.append(Finding.judged(PART, "memory", told, short, remedy, Level.PROBLEM))
    if manifest.steps > 1 and manifest.calibration is None:
        remedy = "It computes everything, in many times the time. Run: ttscompile calibrate DIR --trajectories FILE."
        found.append(Finding(PART, "plan", "dense: not calibrated", Level.WARNING, remedy))
    else:
        told = f"default {manifest.default_plan!r}; it has {', '.join(manifest.plans)}"
        found.append(Finding(PART, "plan", told))
    return found


def _call(artifact: Artifact) -> list[Finding]:
    from ttscompile.runtimes.open import open_runtime
    from ttscompile.runtimes.policy import CompiledPolicy
    from ttscompile.runtimes.random_calls import random_call

    try:
        policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)
        obs, noise = random_call(artifact.manifest.spec, 0, 0)
        times = []
        for _ in range(CALLS):
            policy.forget_frames()
            policy.predict_action(obs, noise=noise)
            report = policy.last_report
            assert report is not None  # a call was made
            times.append(report.timings.total)
    except NonFiniteActionsError:
        remedy = "The weights are damaged, or the checkpoint's were: convert it again, and try plan='dense'."
        return [Finding(PART, "call", "the actions are not finite numbers", Level.PROBLEM, remedy)]
    except TtscompileError as error:
        return [Finding(PART, "call", str(error), Level.PROBLEM, "As the message says.")]
    except Exception as error:  # of onnxruntime: an instruction that the processor lacks, no memory
        remedy = "Tell what it is to the project, with the output of: ttscompile doctor DIR --json."
        return [Finding(PART, "call", f"fails: {type(error).__name__}: {error}", Level.PROBLEM, remedy)]
    chunk = artifact.manifest.spec.chunk
    median = statistics.median(times[1:])
    took = f"{median:.1f} ms with one thread (the first {times[0]:.1f})"
    told = f"{took}, for {chunk.executes} actions: {1000 / median:.1f} calls a second"
    return [Finding(PART, "call", told)]


def target_findings(
    target: Path | str, recordings: Sequence[Path | str] = (), sources: Mapping[str, Sequence[str]] | None = None
) -> list[Finding]:
    """What ``convert`` takes or wrote, and whether recordings fit it; see there and ``load_trajectories``."""
    try:
        from ttscompile.artifact.archive import is_checkpoint
        from ttscompile.artifact.load import load_artifact
        from ttscompile.trajectories.fits import examine_recordings

        tokenizer = None
        if isinstance(target, str) or is_checkpoint(target):
            found, spec = _checkpoint(target)
        else:
            found = artifact_findings(target)
            if not recordings or any(one.what == "load" for one in found):
                return found
            artifact = load_artifact(target)
            spec, tokenizer = artifact.manifest.spec, artifact.tokenizer
        return [*found, *(examine_recordings(recordings, spec, sources or {}, tokenizer) if recordings else [])]
    except ModuleNotFoundError as error:
        told = f"not tried: {(error.name or '').partition('.')[0]} is not installed"
        return [Finding(CHECKPOINT, "load", told, Level.PROBLEM, "Run: pip install 'ttscompile[compile]'.")]
    except TtscompileError as error:
        return [Finding(CHECKPOINT, "load", str(error), Level.PROBLEM, "As the message says; nothing else was tried.")]


def _checkpoint(target: Path | str) -> tuple[list[Finding], PolicySpec]:
    from ttscompile.frontends import load_checkpoint_policy
    from ttscompile.frontends.examined import examine
    from ttscompile.hub import fetch_checkpoint

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        path = target if isinstance(target, Path) else fetch_checkpoint(target).path
        spec = load_checkpoint_policy(path)[1]
    found = [Finding(CHECKPOINT, "load", str(each.message), Level.NOTE) for each in said]
    found.append(Finding(CHECKPOINT, "policy", ", ".join(f"{name} {told}" for name, told in spec.source.items())))
    return [*found, *examine(path, spec)], spec
