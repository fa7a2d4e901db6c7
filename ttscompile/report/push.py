"""An artifact, with a card made of what it says of itself, into a repository of the hub."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from ..artifact.load import load_artifact
from ..artifact.manifest import MANIFEST
from ..core.paths import HUB
from ..core.plan import DENSE
from ..hub import upload
from ..hub.name import require_repository
from ..runtimes.open import open_runtime
from ..runtimes.policy import CompiledPolicy
from .card import card, licence_of, read_success
from .timing import measure_plans


def push(
    directory: str | os.PathLike[str],
    repository: str,
    *,
    evaluations: Sequence[str | os.PathLike[str]] = (),
    licence: str | None = None,
    private: bool = False,
    runs: int = 10,
    dry_run: bool = False,
    progress: Callable[[str], None] = lambda what: None,
) -> str:
    """Upload an artifact with a model card.

    The card has the base model and its licence, sampler, plan, sparsity, the errors of the calibration, what was
    evaluated, times of calls measured now on this machine, and the commands. Nothing else than the artifact's files
    and the card is uploaded; a repository that holds something else than an artifact is left alone.

    Args:
        directory: the artifact, or the same zipped.
        repository: ``org/name``, or the same after ``hf://``.
        evaluations: documents of ``examples/evaluation/evaluate.py --json`` with success figures of this artifact.
        licence: of a base that did not say one, as the hub writes it (``apache-2.0``).
        private: whether a repository that is made now is nobody else's to see.
        runs: counted calls of each plan for the times.

    Returns:
        ``hf://org/name@commit``; with ``dry_run`` the card.

    Raises:
        ArtifactError: there is no artifact, or it changed meanwhile.
        ReportError: an evaluation is none, or of another artifact; the licence is not the base's.
        HubError: the repository cannot be written, or holds something else.
        RuntimeUnavailableError: ``huggingface_hub`` is not installed.
    """
    repository = repository.removeprefix(HUB)
    require_repository(repository, repository)
    artifact = load_artifact(Path(directory))
    manifest = artifact.manifest
    success = [one for path in evaluations for one in read_success(Path(path), manifest.identity)]
    licence = licence_of(manifest, licence)
    progress("timing calls")
    policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)
    plans = tuple(dict.fromkeys((manifest.default_plan, DENSE)))
    text = card(artifact, repository, measure_plans(policy, artifact.manifest.spec, plans, runs), success, licence)
    if dry_run:
        return text
    progress("uploading")
    with artifact.reading():  # what is uploaded is what was checked
        return upload(artifact.files, [MANIFEST, *manifest.files], repository, text, private=private)
