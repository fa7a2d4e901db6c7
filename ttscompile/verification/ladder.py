"""The ladder: every rung stands on those below it."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..artifact.archive import is_checkpoint
from ..artifact.codec import is_as_written
from ..artifact.files import check_file
from ..artifact.golden import load_golden, load_golden_plans
from ..artifact.load import Artifact, load_artifact, present, read_manifest, require_artifact_path
from ..artifact.manifest import MANIFEST
from ..artifact.view import view_of
from ..artifact.write import BESIDE
from ..core.coercion import integer
from ..core.plan import DENSE
from ..errors import ArtifactChangedError, ArtifactError, RuntimeUnavailableError, TtscompileError
from ..runtimes.open import MOST_THREADS, open_runtime
from ..runtimes.policy import CompiledPolicy
from ..trajectories.episodes import episodes_of
from .calls import DENSE_CALL, PLANS, RUNTIMES, TOKENS, check_dense, check_plans, check_runtimes, check_tokens
from .network import BLOCK, EVALUATION, PREPROCESSING, Probe, check_blocks, check_evaluation, check_preprocessing
from .precision import PLANS_PRECISION, PRECISION, check_plans_precision, check_precision
from .reuse import DISTANCE, ENGAGED, Progress, check_engaged, check_episodes, choose
from .rung import FAILED, PASSED, ErrorMap, Rung, Verification

INTEGRITY = "integrity"


def verify(
    path: str | os.PathLike[str],
    trajectories: Sequence[str | os.PathLike[str]] = (),
    *,
    sources: Mapping[str, Sequence[str]] | None = None,
    calls: int = 24,
    threads: int = 1,
    progress: Progress = lambda what: None,
) -> Verification:
    """Check an artifact, without the checkpoint that it was made from, and without torch.

    From the bottom: its bytes; what is around the network; each residual block; single evaluations; a dense call, which
    are all held against what the original network answered when the artifact was made; the runtimes against each other
    (where there is torch); plans against what calibration stored; how far they are from the original over whole
    recorded episodes; and whether they save anything. A rung that fails says where, and what to do; those above it
    are tried all the same, except after the first.

    Args:
        path: the artifact's directory, or the same zipped.
        trajectories: recorded episodes, see ``ttscompile.trajectories``. None: how far plans are is not judged.
        sources: by key of the observation, the arrays of a recording that it is made of.
        calls: recorded calls to go through at least, in whole episodes.

    Returns:
        What every rung found. Nothing is raised for a rung that fails.

    Raises:
        ArtifactError: there is no artifact, none that was made with a golden record, or a copy without its fp32.
        TrajectoryError: the recordings do not fit the policy.
        RuntimeUnavailableError: onnxruntime is missing.
    """
    calls = integer(calls, "calls", TtscompileError, 1)
    threads = integer(threads, "threads", RuntimeUnavailableError, 1, MOST_THREADS)
    begun = time.monotonic()
    progress(INTEGRITY)
    rung, artifact = check_integrity(Path(path))
    if artifact is None:
        return Verification(str(path), None, None, (rung,), time.monotonic() - begun)
    artifact.require_whole()
    manifest, episodes = artifact.manifest, []
    if trajectories:
        episodes = choose(episodes_of(manifest.spec, trajectories, sources, artifact.tokenizer), calls)
    rungs, errors = _climb(artifact, episodes, threads, progress)
    seconds = time.monotonic() - begun
    return Verification(str(path), manifest.identity, manifest.model_identity, (rung, *rungs), seconds, errors)


def check_integrity(path: Path) -> tuple[Rung, Artifact | None]:
    """Hash every file, and open the artifact: None if that fails. ArtifactError is for what cannot be an artifact.

    Raises:
        ArtifactError: there is nothing at this path that could be an artifact.
    """
    require_artifact_path(path)
    if (path.is_dir() and not (path / MANIFEST).is_file()) or is_checkpoint(path):
        load_artifact(path)  # says what is wrong
    artifact, wrong = None, list[str]()
    try:
        artifact = load_artifact(path)
        # Two spellings of one document have one checksum.
        with artifact.reading(MANIFEST):
            if not is_as_written(artifact.manifest, (artifact.files / MANIFEST).read_bytes()):
                wrong = [f"{path / MANIFEST}: is written otherwise than ttscompile writes it; the file was changed."]
    except ArtifactChangedError:
        raise  # nothing is wrong with it
    except ArtifactError as error:
        wrong = (_wrong_files(path) if path.is_dir() else []) or [str(error)]
    if artifact is None or wrong:
        remedy = "Copy the artifact again, or convert the checkpoint again."
        told = f"{len(wrong)} of its files are not as written: " * (len(wrong) > 1) + " ".join(wrong)
        return Rung(INTEGRITY, FAILED, told, len(wrong), 0, "files", remedy, details={"wrong": wrong}), None
    files, size = artifact.present, artifact.bytes / 1e6
    other = sorted({p.name for p in path.iterdir()} - {MANIFEST, *BESIDE, *files}) if path.is_dir() else []
    more = f"; {len(other)} more, which nothing reads: {', '.join(other[:3])}" if other else ""
    told = f"manifest and {len(files)} files, {size:.1f} MB, have the hashes that they were written with{more}"
    return Rung(INTEGRITY, PASSED, told, 0, 0, "files", details={"unlisted": other}), artifact


def _wrong_files(directory: Path) -> list[str]:
    try:
        manifest = read_manifest(directory)
    except ArtifactError as error:
        return [str(error)]
    wrong = []
    for name in present(manifest, directory):
        try:
            check_file(directory / name, manifest.files[name])
        except ArtifactError as error:
            wrong.append(str(error))
    return wrong


def _climb(
    artifact: Artifact, episodes: Sequence[Any], threads: int, progress: Progress
) -> tuple[list[Rung], ErrorMap | None]:
    artifact = replace(artifact, envelope=None)  # inputs of the record are random, and plans are to be as they are
    golden = load_golden(artifact)
    recorded, dense = load_golden_plans(artifact, golden.streams), artifact.plans[DENSE]
    try:
        probe = Probe(view_of(artifact, dense), golden.network_observations(artifact.manifest.spec))
        runtime = open_runtime(artifact, threads=threads, plan=dense)
    except ArtifactError as error:
        return [Rung(BLOCK, FAILED, str(error))], None
    policy = CompiledPolicy(artifact, runtime, seed=0, plan=dense)
    rungs: list[Rung] = []
    errors: ErrorMap | None = None

    def climb(name: str, check: Callable[[], Rung | None]) -> None:
        progress(name)
        try:
            rung = check()
        except TtscompileError as error:
            rung = Rung(name, FAILED, str(error))
        if rung is not None:
            rungs.append(rung)

    def blocks() -> Rung:
        nonlocal errors
        rung, errors = check_blocks(artifact, golden, probe)
        return rung

    def plans() -> Rung:
        nonlocal errors
        rung, differing = check_plans(artifact, golden, recorded, runtime)
        if errors is not None and differing:
            name, cells = next(iter(differing.items()))
            errors = replace(errors, plan=name, cells=cells)
        return rung

    climb(PREPROCESSING, lambda: check_preprocessing(artifact, golden))
    climb(BLOCK, blocks)
    climb(EVALUATION, lambda: check_evaluation(artifact, golden, probe, rungs[-1]))
    climb(DENSE_CALL, lambda: check_dense(policy, artifact, golden))
    climb(PRECISION, lambda: check_precision(artifact, golden, runtime))
    climb(TOKENS, lambda: check_tokens(artifact, golden, runtime))
    climb(RUNTIMES, lambda: check_runtimes(artifact, golden, runtime))
    climb(PLANS, plans)
    climb(PLANS_PRECISION, lambda: check_plans_precision(artifact, golden, recorded, runtime))
    climb(DISTANCE, lambda: check_episodes(artifact, policy, episodes, progress))
    climb(ENGAGED, lambda: check_engaged(artifact, golden, policy))
    return rungs, errors
