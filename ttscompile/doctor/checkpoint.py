"""What of a checkpoint, and of recordings beside it, goes wrong on a robot without an error. Imports at need."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.finding import Finding, Level
from ..errors import TtscompileError
from .artifact import artifact_findings

if TYPE_CHECKING:
    from ..core.spec import PolicySpec

PART = "checkpoint"


def target_findings(
    target: Path | str, recordings: Sequence[Path] = (), sources: Mapping[str, Sequence[str]] | None = None
) -> list[Finding]:
    """What ``convert`` takes or wrote, and whether recordings fit it; see there and ``load_trajectories``."""
    try:
        from ..artifact.archive import is_checkpoint
        from ..artifact.load import load_artifact
        from ..trajectories.fits import examine_recordings

        if isinstance(target, str) or is_checkpoint(target):
            found, spec = _checkpoint(target)
        else:
            found = artifact_findings(target)
            if not recordings or any(one.what == "load" for one in found):
                return found
            spec = load_artifact(target).manifest.spec
        return [*found, *(examine_recordings(recordings, spec, sources or {}) if recordings else [])]
    except ModuleNotFoundError as error:
        told = f"not tried: {(error.name or '').partition('.')[0]} is not installed"
        return [Finding(PART, "load", told, Level.PROBLEM, "Run: pip install 'ttscompile[compile]'.")]
    except TtscompileError as error:
        return [Finding(PART, "load", str(error), Level.PROBLEM, "As the message says; nothing else was tried.")]


def _checkpoint(target: Path | str) -> tuple[list[Finding], PolicySpec]:
    from ..frontends import load_checkpoint_policy
    from ..frontends.examined import examine
    from ..hub import fetch_checkpoint

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        path = target if isinstance(target, Path) else fetch_checkpoint(target).path
        spec = load_checkpoint_policy(path)[1]
    found = [Finding(PART, "load", str(each.message), Level.NOTE) for each in said]
    found.append(Finding(PART, "policy", ", ".join(f"{name} {told}" for name, told in spec.source.items())))
    return [*found, *examine(path, spec)], spec
