"""What is settled beside plans: one record of the manifest each, whether and how."""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import replace
from typing import Literal

from ..errors import ArtifactError
from .codec import decode, encode
from .files import replace_file
from .load import load_artifact
from .manifest import MANIFEST, Manifest
from .tokens import ReuseRecord
from .warm import WarmRecord
from .write import identified, locked, require_unzipped


def settle(
    path: str | os.PathLike[str],
    what: Literal["reuse", "warm"],
    record: ReuseRecord | WarmRecord | None,
    held: bool = False,
) -> Manifest:
    """Have an artifact reuse tokens, or begin calls with the chunk before, in another way. Plans and weights stay.

    Args:
        path: the artifact's directory.
        what: the field of the manifest.
        record: what it will be; None for not at all.
        held: whether the caller has the artifact ``locked``.

    Returns:
        The new manifest.

    Raises:
        ArtifactError: no artifact, a zipped one, one that is being updated, or one that cannot be so.
    """
    directory = require_unzipped(path)
    with nullcontext() if held else locked(directory):
        manifest = replace(load_artifact(directory).manifest, **{what: record})  # type: ignore[arg-type]
        content = encode(identified(manifest))
        manifest = decode(content)  # refuses what nobody could load
        try:
            replace_file(directory / MANIFEST, content)
        except OSError as error:
            raise ArtifactError(f"{directory}: cannot be updated: {error}. It is as it was.") from error
    return manifest
