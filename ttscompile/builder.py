"""From a checkpoint to the fastest policy that is safe, as one call: convert, learn, choose."""

import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .artifact.files import aside, locked, writing
from .artifact.load import load_artifact, read_manifest
from .artifact.manifest import MANIFEST
from .artifact.write import learned_plans, replacing
from .calibration.arguments import require_rate
from .calibration.budget import SPARSITY, Goal
from .calibration.calls import load_episodes
from .calibration.pipeline import CalibrationResult, calibrate
from .calibration.proposer import Request
from .calibration.proposers import LOOPS, rows_of
from .calibration.state import FILE as STATE
from .core.spec import INT8, PolicySpec
from .driver import Explain, convert
from .errors import ArtifactError, CalibrationError, CalibrationFailedError
from .frontends import recordings_of
from .runtimes.executor.settings import ExecutorSettings, resolve
from .runtimes.load import open_policy
from .trajectories import recorded_rate

FURTHER_LOOPS = (("dpmsolver++", 16), ("ddim", 16))
"""Beside the policy's own. Of a flow-matching policy its own is all: of its ten Euler steps two or three are computed,
which is nearer to the original than a loop of as many."""

LEARNED = (LOOPS, "precision", "tokens")
"""What is learned, where it applies. Starts from the chunk before and trained weights are left to ``calibrate``: where
they were tried they were no default, and the second take most of an hour."""


def build(
    checkpoint: str | os.PathLike[str],
    directory: str | os.PathLike[str],
    trajectories: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
    *,
    control_hz: float | None = None,
    policy_hz: float | None = None,
    latency_ms: float | None = None,
    max_distance: float | None = None,
    threads: int = 1,
    max_minutes: float = 30.0,
    seed: int = 0,
    resume: bool = False,
    observation: Mapping[str, Sequence[str]] | None = None,
    progress: bool = True,
    ray: str | None = None,
    explain: Explain = lambda stage, notes: None,
    **of_checkpoint: Any,
) -> CalibrationResult:
    """Convert a checkpoint, try what a plan can be, and make the fastest one the default that is near to the original.

    Tried are loops, numbers and places of computed steps with their corrections, eight bits by part, and the tokens of
    image encoders. All are judged on held-out episodes against the original, and timed on this machine. If
    other plans take at most a fifth longer than the fastest and are nearer by more than a fifth, one of them is chosen.

    All is done in a folder beside ``directory``. It stays until the next build where there is a state to go on from:
    after an interruption, an error, or an end with the original as the default.
    ``checkpoint``, ``directory`` and ``explain`` are those of ``convert``; ``observation``, ``progress`` and ``ray``
    those of ``calibrate``.

    Args:
        trajectories: recorded episodes; see ``calibrate``. Without any those are taken that the policy was trained on
            (``frontends.recordings_of``).
        control_hz: rate of a control loop that the policy has to keep up with, in the executor's own settings. The
            plan is then the nearest of those of whose calls 99 of 100 keep up.
        policy_hz: rate of the frames and actions that the policy was trained with; see ``calibrate``. If nobody says
            it, the deadline is that of ``control_hz``.
        latency_ms: that 99 of 100 calls may take at most, in place of ``control_hz``.
        max_distance: from the original, that a plan may have (``calibration.proposer.near``), in units of what other
            noise changes; None for a tenth for the default, and a quarter for faster plans (``artifact.ceiling``).
        threads: that calls have.
        max_minutes: by the clock, for all but the conversion.
        seed: of everything random.
        resume: go on where the same build was interrupted, or ended with the original; anew if there is no such state.
        of_checkpoint: ``format``, ``task``, ``encoders``, ``without_cameras`` and ``base`` of ``convert``.

    Raises:
        CalibrationFailedError: no plan is near enough, or none of these keeps up; says how far the nearest is.
        TtscompileError: as ``convert`` and ``calibrate``. After any error ``directory`` is as it was.
    """
    if latency_ms is not None and control_hz is not None:
        raise CalibrationError("expected one deadline; found latency_ms and control_hz. Give one of them.")
    require_rate(policy_hz)
    named = (trajectories,) if isinstance(trajectories, str | os.PathLike) else tuple(trajectories)
    if not named:
        named = (recordings_of(checkpoint, of_checkpoint.get("format", "auto")),)
        explain("recordings", (f"no episodes were given, so those of its training are read: {named[0]}",))

    def check(spec: PolicySpec) -> None:
        if spec.instruction is None:  # else the artifact's tokenizer is needed
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # calibration reads them again, and warns
                load_episodes(spec, named, observation)

    how: dict[str, Any] = {"loops": FURTHER_LOOPS, "prediction_horizon": "needed", "precision": INT8, "read": check}
    how |= of_checkpoint
    target = Path(os.path.realpath(directory))
    with replacing(target) as put, _beside(target) as made:
        _convert(checkpoint, made, resume, explain, how)
        if control_hz is not None:
            policy_hz = policy_hz or recorded_rate(named)
            latency_ms = _deadline(made, control_hz, policy_hz, explain)
        artifact, request = load_artifact(made), Request(Goal(SPARSITY, 0.5))  # a goal that none of these reads
        rows = [row for row in rows_of(LEARNED) if row.name == LOOPS or row.make(request).applies(artifact) is None]
        result = calibrate(
            made,
            named,
            learn=[row.name for row in rows],
            latency_ms=latency_ms,
            max_distance=max_distance,
            policy_hz=policy_hz,
            threads=threads,
            max_minutes=max_minutes,
            seed=seed,
            resume=resume,
            observation=observation,
            progress=progress,
            ray=ray,
        )
        if (made / STATE).is_file():
            (made / STATE).replace(_kept(made))
        put(made)
        if _kept(made).is_file():
            told = "more --minutes, or with another --error, goes on from what was answered and searched"
            explain("end", (f"the original is the default. The same command with --resume and {told}.",))
    return result


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """Where one process alone makes an artifact; gone afterwards, unless that is unfinished, or cannot be moved."""
    made = (folder := aside(target, "building")) / "artifact"
    with writing(target):
        folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        try:
            yield made
        except (ArtifactError, CalibrationFailedError) as error:
            kept = f" What was done is in {made}, for --resume or as it is." if _worth_keeping(made) else ""
            raise type(error)(f"{error}{kept}") from error
        finally:
            if not _worth_keeping(made):
                shutil.rmtree(folder, ignore_errors=True)


def _worth_keeping(made: Path) -> bool:
    return (made / STATE).is_file() or _kept(made).is_file() or bool(learned_plans(made))


def _kept(made: Path) -> Path:
    """The state of a build that ended with the original, once the artifact that was ``made`` is in its place."""
    return made.with_name(STATE)


def _convert(
    checkpoint: str | os.PathLike[str], directory: Path, resume: bool, explain: Explain, how: Mapping[str, Any]
) -> None:
    """Convert; where an interrupted build has done that, see that it was of this checkpoint, and leave it."""
    again = directory.with_name("again")
    for made in (directory, again):
        if not (made / MANIFEST).is_file():  # killed while it was removed, that build left a part of it
            shutil.rmtree(made, ignore_errors=True)
    if not (resume and (directory / STATE).is_file()):
        convert(checkpoint, directory, explain=explain, **how)
        if resume and _kept(directory).is_file():  # calibration sees that it is of this model
            _kept(directory).replace(directory / STATE)
        elif resume:
            explain("resume", (f"{directory}: there is nothing to go on from, so the build begins anew",))
        _kept(directory).unlink(missing_ok=True)
        return
    convert(checkpoint, again, explain=explain, **how)
    found, expected = (read_manifest(each).model_identity for each in (directory, again))
    shutil.rmtree(again, ignore_errors=True)
    if found != expected:
        told = f"{directory}: expected the interrupted build of {os.fspath(checkpoint)}; found another model"
        raise CalibrationError(f"{told}. Leave --resume out to begin anew.")


def _deadline(directory: Path, control_hz: float, policy_hz: float | None, explain: Explain) -> float:
    """Milliseconds that a call may take for the policy to keep up with a control loop; says why."""
    info = open_policy(load_artifact(directory), plan="dense").info
    loop = resolve(ExecutorSettings(policy_hz=policy_hz), info, control_hz)
    longest = loop.feasibility(1e-3).max_latency
    if longest <= 0:
        raise CalibrationFailedError(
            f"no call is short enough for a control loop of {control_hz:g} Hz: a chunk is over before the next frame."
            " Give the rate that the policy was trained with, --policy-hz."
        )
    unknown = f"nobody says at which rate the policy was trained: {control_hz:g} Hz are assumed (--policy-hz)"
    actions = f"{loop.horizon} actions of a chunk, and has {loop.reserve} more in reserve for one that comes late"
    allowed = f"calls may take {1e3 * longest:.4g} ms: the executor plays {actions}"
    explain("loop", (*[unknown] * (policy_hz is None), f"{allowed}, at {loop.policy_hz:g} Hz"))
    return 1e3 * longest
