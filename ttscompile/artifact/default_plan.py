"""Make another plan of an artifact the default."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ..errors import ArtifactError
from . import records
from .files import replace_file
from .load import Artifact, read_manifest
from .manifest import MANIFEST, Manifest
from .write import finished, locked, require_unzipped


def choose_default(
    path: str | os.PathLike[str],
    name: str,
    record: Mapping[str, Any],
    precision: Mapping[str, str] | None,
    seen: Artifact,
) -> Manifest:
    """Make a plan that is there the default.

    Args:
        path: the artifact's directory.
        record: see ``update_plans``.
        precision: that the plan has from now on; None leaves it.
        seen: the artifact as it was looked at; another one that has taken its place is refused.

    Raises:
        ArtifactError: as ``update_plans``, or the artifact was replaced meanwhile.
    """
    directory = require_unzipped(path)
    with locked(directory):
        manifest = read_manifest(directory)
        if manifest.identity != seen.manifest.identity:
            raise ArtifactError(f"{directory}: it was replaced meanwhile, and was not changed. Try again.")
        own = manifest.plans[name]
        plans = {**manifest.plans, name: own if precision is None else replace(own, precision=precision)}
        told = records.calibration_record(record)
        manifest, content = finished(replace(manifest, plans=plans, default_plan=name, calibration=told))
        try:
            replace_file(directory / MANIFEST, content)
        except OSError as error:
            raise ArtifactError(f"{directory}: cannot be updated: {error}. It is as it was.") from error
    return manifest
