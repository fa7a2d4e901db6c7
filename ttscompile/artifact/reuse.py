"""Whether and how an artifact reuses tokens from frame to frame: one record of its manifest."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from ..errors import ArtifactError
from .codec import decode, encode, identities
from .files import replace_file
from .load import load_artifact, require_artifact_path
from .manifest import MANIFEST, Manifest
from .tokens import ReuseRecord
from .write import locked


def update_reuse(path: str | os.PathLike[str], reuse: ReuseRecord | None) -> Manifest:
    """Have an artifact reuse tokens in another way: at once, or not at all. Plans and weights stay.

    Args:
        path: the artifact's directory.
        reuse: how; None for not at all.

    Returns:
        The new manifest.

    Raises:
        ArtifactError: no artifact, a zipped one, one that is being updated, or one without tokens.
    """
    directory = Path(path)
    require_artifact_path(directory)
    if not directory.is_dir():
        raise ArtifactError(f"{directory}: expected a directory; found a file. Unzip it and give the directory.")
    with locked(directory):
        manifest = replace(load_artifact(directory).manifest, reuse=reuse)
        identity, model_identity = identities(manifest)
        content = encode(replace(manifest, identity=identity, model_identity=model_identity))
        manifest = decode(content)  # refuses what nobody could load
        try:
            replace_file(directory / MANIFEST, content)
        except OSError as error:
            raise ArtifactError(f"{directory}: cannot be updated: {error}. It is as it was.") from error
    return manifest
