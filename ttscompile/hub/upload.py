"""Put an artifact and its card into a repository of the hub, in one commit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import HubError
from .fetch import CARD, MANIFEST, library, told
from .name import HubName, require_repository

_MADE_BY_THE_HUB = frozenset({".gitattributes", CARD})


def upload(folder: Path, names: Sequence[str], repository: str, card: str, *, private: bool = False) -> str:
    """Commit these files and the card; the repository is made if it is not there.

    Args:
        private: whether the repository is nobody else's to see; one that is there already must be private then.

    Returns:
        ``hf://org/name@commit``.

    Raises:
        HubError: the repository holds something else than an artifact, is public although ``private`` was asked for, or
            cannot be written.
        RuntimeUnavailableError: ``huggingface_hub`` is not installed.
    """
    require_repository(repository, repository)
    hub = library()
    with told(repository):
        api = hub.HfApi()
        api.create_repo(repository, private=private, exist_ok=True)
        if private and not api.repo_info(repository).private:
            raise HubError(f"{repository}: expected a private repository; it is public already. Give another.")
        there = set(api.list_repo_files(repository)) - _MADE_BY_THE_HUB
        if there and MANIFEST not in there:
            found = ", ".join(sorted(there)[:3])
            raise HubError(f"{repository}: expected an empty repository or an artifact; it has {found}. Give another.")
        files = [hub.CommitOperationAdd(name, str(folder / name)) for name in names]
        operations = [*files, hub.CommitOperationAdd(CARD, card.encode())]
        made = api.create_commit(repository, operations, commit_message="Upload an artifact of ttscompile")
        return HubName(repository).at(str(made.oid))
