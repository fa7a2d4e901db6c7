"""``ttscompile inspect -o``: everything about an artifact on one page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import ttscompile
from ttscompile.artifact.files import replace_file
from ttscompile.artifact.load import Artifact
from ttscompile.cli.recordings import Sources
from ttscompile.errors import ArtifactChangedError, ArtifactError, OutputError
from ttscompile.report import Given, Section, build, render, verified
from ttscompile.report.page import require_packages
from ttscompile.runtimes.policy import CompiledPolicy


def require_page(path: Path) -> None:
    """See, before minutes of work, whether a page can be made there.

    Raises:
        OutputError: there is no such folder, or the name is of no page.
        RuntimeUnavailableError: matplotlib or Jinja2 is not installed.
    """
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: the page cannot be written: no such folder. Give one that exists.")
    if path.suffix not in (".html", ".htm"):
        raise OutputError(f"{path}: the page is HTML. Give a name that ends in .html.")
    require_packages()


def write_page(
    path: Path, artifact: Artifact, policy: CompiledPolicy, given: Given, progress: Callable[[str], None]
) -> str:
    """Write the page; it replaces another one only when it is whole.

    Args:
        path: see ``require_page``.
        artifact: loaded.
        policy: the same, with a seed; its calls are timed now.
        given: what the page shows beside the artifact.
        progress: told what is under way.

    Returns:
        What was written, for people.

    Raises:
        OutputError: it cannot be written.
    """
    page = render(build(artifact, policy, given, progress))
    try:
        replace_file(path, page.encode())
    except OSError as error:
        raise OutputError(f"{path}: the page cannot be written: {error}. Give a folder that exists.") from error
    return f"wrote {path}, {len(page) / 1e6:.2f} MB"


def checked(
    directory: Path,
    identity: str,
    trajectories: Sequence[Path],
    sources: Sources,
    progress: Callable[[str], None],
) -> tuple[bool, Section]:
    """Whether the checks of ``ttscompile verify`` hold for the artifact of this identity, and what the page says.

    Raises:
        ArtifactChangedError: another one is there by now.
    """
    try:
        found = ttscompile.verify(
            directory, trajectories, sources=sources, progress=lambda it: progress(f"verifying: {it}")
        )
        if found.identity not in (None, identity):
            raise ArtifactChangedError(f"{directory}: was replaced meanwhile. Inspect it again.")
        return found.passed, verified(found)
    except ArtifactChangedError:
        raise
    except ArtifactError as error:  # it has nothing to check against, and so fails nothing
        return True, Section("Verification", (f"Could not be run: {error}",))
