"""Whether and how an artifact reuses tokens from frame to frame: one record of its manifest."""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import replace

from ..errors import ArtifactError
from .codec import decode, encode
from .files import replace_file
from .load import load_artifact
from .manifest import MANIFEST, Manifest
from .tokens import ReuseRecord
from .write import identified, locked, require_unzipped


def update_reuse(path: str | os.PathLike[str], reuse: ReuseRecord | None, held: bool = False) -> Manifest:
    """Have an artifact reuse tokens in another way: at once, or not at all. Plans and weights stay.

    Args:
        path: the artifact's directory.
        reuse: how; None for not at all.
        held: whether the caller has the artifact ``locked``.

    Returns:
        The new manifest.

    Raises:
        ArtifactError: no artifact, a zipped one, one that is being updated, or one without tokens.
    """
    directory = require_unzipped(path)
    with nullcontext() if held else locked(directory):
        content = encode(identified(replace(load_artifact(directory).manifest, reuse=reuse)))
        manifest = decode(content)  # refuses what nobody could load
        try:
            replace_file(directory / MANIFEST, content)
        except OSError as error:
            raise ArtifactError(f"{directory}: cannot be updated: {error}. It is as it was.") from error
    return manifest
