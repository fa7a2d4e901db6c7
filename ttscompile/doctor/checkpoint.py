"""What of a checkpoint, and of recordings beside it, goes wrong on a robot without an error. Imports at need."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.finding import Finding, Level
from ..errors import TtscompileError
from .artifact import artifact_findings

if TYPE_CHECKING:
    from ..core.spec import PolicySpec

PART = "checkpoint"
_REMEDY = "As the message says; nothing else was tried."


def target_findings(
    target: Path | str,
    recordings: Sequence[Path] = (),
    sources: Mapping[str, Sequence[str]] | None = None,
    encoders: Path | None = None,
) -> list[Finding]:
    """A checkpoint or an artifact, and whether recordings fit it.

    Args:
        target: what ``convert`` takes, or wrote.
        recordings: see ``load_trajectories``.
        sources: the same.
        encoders: see ``convert``.
    """
    means: dict[str, Any] = {}
    try:
        from ..artifact.archive import is_checkpoint
        from ..artifact.load import load_artifact

        if isinstance(target, Path) and not is_checkpoint(target):
            found = artifact_findings(target)
            if not recordings or any(one.what == "load" for one in found):
                return found
            spec: PolicySpec | None = load_artifact(target).manifest.spec
        else:
            found, spec, means = _checkpoint(target, encoders)
        if recordings and spec is not None:
            from ..trajectories.fits import examine_recordings

            found += examine_recordings(recordings, spec, sources or {}, means)
    except ModuleNotFoundError as error:
        missing, remedy = (error.name or "").partition(".")[0], "Run: pip install 'ttscompile[compile]'."
        return [Finding(PART, "load", f"not tried: {missing} is not installed", Level.PROBLEM, remedy)]
    return found


def _checkpoint(target: Path | str, encoders: Path | None) -> tuple[list[Finding], PolicySpec | None, dict[str, Any]]:
    """Can it be converted, and what is in it; its specification; and by camera the mean picture of its training."""
    from ..frontends import load_checkpoint_policy
    from ..frontends.examined import examine, statistics
    from ..frontends.families import LoadOptions
    from ..hub import fetch_checkpoint

    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            path = target if isinstance(target, Path) else fetch_checkpoint(target).path
            spec = load_checkpoint_policy(path, options=LoadOptions(encoders=encoders))[1]
        found = [Finding(PART, "load", str(each.message), Level.NOTE) for each in said]
        found.append(Finding(PART, "policy", ", ".join(f"{name} {told}" for name, told in spec.source.items())))
        found += examine(path, spec, encoders)
        by_mean = {key: one for key, one in statistics(path, spec).items() if one.mode == "MEAN_STD"}
        return found, spec, {key: one.first.flatten().numpy() for key, one in by_mean.items()}
    except TtscompileError as error:
        return [Finding(PART, "load", str(error), Level.PROBLEM, _REMEDY)], None, {}
