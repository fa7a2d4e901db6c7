"""Repositories of the hub: download what an artifact or a checkpoint is made of, and nothing else; upload an artifact.

``hf://org/name[@revision][/path]`` says which repository, which state of it, and what in it.
The library downloads into its cache, checks sizes, and gives the folder of one commit. A second time, and where there
is no network, that folder is all that is read. Nothing of a repository is executed, here or later: an artifact is
checked by ``load`` as any other, and a checkpoint read by ``convert`` as any other.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ..core.paths import HUB
from ..core.untrusted_json import parse_json
from ..errors import HubError, TtscompileError, needing

_PART = r"[A-Za-z0-9][A-Za-z0-9._-]{0,95}"
_REPOSITORY = re.compile(f"{_PART}/{_PART}")
_REVISION = re.compile(r"[A-Za-z0-9][A-Za-z0-9._/-]{0,199}")
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.=+ -]{0,199}")
"""Of a file or a folder: nothing that a path, a pattern or a terminal would take for something else."""
EXPECTED = "expected hf://ORGANISATION/NAME, and perhaps @REVISION and /PATH after it"
DATA_SETS = f"{HUB}datasets/"
"""How the name of a data set begins."""


@dataclass(frozen=True)
class HubName:
    """A name, read.

    Attributes:
        repository: ``org/name``.
        revision: a branch, a tag or a commit; None for the branch ``main``.
        inside: of a file or a folder in it; empty for all of it.
    """

    repository: str
    revision: str | None = None
    inside: str = ""

    @property
    def folder(self) -> str:
        """What the names of files in it begin with."""
        return f"{self.inside}/" if self.inside else ""

    def at(self, commit: str) -> str:
        """The same name, of one commit."""
        return f"{HUB}{self.repository}@{commit}" + (f"/{self.inside}" if self.inside else "")


def read_name(text: str) -> HubName:
    """Read a name that begins with ``hf://``; a slash in a revision is written ``%2F``. Raises HubError: it is none."""
    organisation, _, rest = text.removeprefix(HUB).partition("/")
    first, _, inside = rest.strip("/").partition("/")
    name, at, revision = first.partition("@")
    made = HubName(f"{organisation}/{name}", unquote(revision) if at else None, inside)
    require_repository(made.repository, text)
    if made.revision is not None and (_REVISION.fullmatch(made.revision) is None or ".." in made.revision):
        raise HubError(f"{text:.200}: @REVISION is a branch, a tag or a commit; {EXPECTED}.")
    if inside and not plain(inside):
        raise HubError(f"{text:.200}: /PATH is that of a file or a folder in the repository; {EXPECTED}.")
    return made


def require_repository(repository: str, told: str) -> None:
    """Raise HubError, with a message that begins with ``told``, unless this is ``org/name``."""
    if _REPOSITORY.fullmatch(repository) is None or "--" in repository or ".." in repository:
        expected = EXPECTED if told.startswith(HUB) else "expected ORGANISATION/NAME"  # to upload to
        raise HubError(f"{told:.200}: this is no name of a repository; {expected}.")


def plain(path: str) -> bool:
    """Whether a path in a repository leads down alone, by names that are nothing else than names."""
    return all(_NAME.fullmatch(part) is not None and not part.endswith((".", " ")) for part in path.split("/"))


MANIFEST = "manifest.json"
CARD = "README.md"
_ABOUT = (CARD, "LICENSE", "LICENSE.md", "LICENSE.txt")
_CONFIG, _WEIGHTS = "config.json", "model.safetensors"
_POLICIES = {_CONFIG, _WEIGHTS}, {_CONFIG, "adapter_config.json", "adapter_model.safetensors"}
"""A whole one, or an adapter."""
_OF_LEROBOT = re.compile(
    rf"(adapter_|train_)?{_CONFIG}|policy_(pre|post)processor\.json|[^/]+\.safetensors"
    r"|[^/]+/(config|vocab|tokenizer|tokenizer_config|special_tokens_map|added_tokens)\.json|[^/]+/merges\.txt"
)
"""What ``convert`` reads of a directory that lerobot saved, whose processors name the files of their statistics as they
like, and of a folder of its encoders in it."""
_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_CHECKPOINT = ".ckpt"
MOST_FILES = 1000
MOST_EPISODES = 32
"""Of a data set, that are downloaded and read."""
_FIRST_EPISODES = (
    *(f"meta/*.{end}" for end in ("json", "jsonl", "parquet")),
    *(f"{one}/chunk-000/file-000.parquet" for one in ("meta/episodes", "data")),
    "videos/*/chunk-000/file-000.mp4",
    *(f"data/chunk-000/episode_{n:06d}.parquet" for n in range(MOST_EPISODES)),
    *(f"videos/chunk-000/*/episode_{n:06d}.mp4" for n in range(MOST_EPISODES)),
)
"""Of version 3, which has many episodes in a file, and of version 2, which has a file for each."""
MOST_MANIFEST_BYTES = 32 << 20
MOST_CARD_BYTES = 1 << 20
_ENDS = (".json", ".onnx", ".safetensors", ".txt", _CHECKPOINT)
"""Of the names of an artifact's and a checkpoint's files: nothing that Python imports or unpickles."""
_COMMIT = re.compile(r"[0-9a-f]{40}")
_LICENCE = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]{0,99}")


@dataclass(frozen=True)
class Fetched:
    """What was downloaded, or was there already.

    Attributes:
        path: of the file or folder that was asked for, in the library's cache.
        origin: ``hf://org/name@commit``, which means the same for ever.
        licence: of the repository, as its card says it; None where it says none.
    """

    path: Path
    origin: str
    licence: str | None


def fetch_artifact(text: str, anew: bool = False) -> Fetched:
    """An artifact: its manifest, and the files that the manifest lists.

    Args:
        text: ``hf://org/name[@revision][/folder]``.
        anew: whether to download what the cache has already, as where it is damaged.

    Raises:
        HubError: there is no such repository, no artifact in it, or no network and nothing in the cache.
        RuntimeUnavailableError: ``huggingface_hub`` is not installed.
    """
    name, hub = read_name(text), library()
    with told(text):
        folder = _snapshot(hub, name.repository, name.revision, [*_ABOUT, name.folder + MANIFEST])
        manifest = folder / name.inside / MANIFEST
        if not manifest.is_file():
            raise HubError(f"{text}: there is no {MANIFEST} in it, so it is no artifact.")
        chosen = [name.folder + each for each in _listed(manifest, text)]
        return _fetched(hub, name, text, folder.name, chosen, anew)


def fetch_checkpoint(text: str) -> Fetched:
    """A checkpoint: a directory of LeRobot, or one ``.ckpt`` file.

    Args:
        text: ``hf://org/name[@revision][/path]``.

    Raises:
        HubError: there is no such repository, no checkpoint in it or several, or no network and nothing in the cache.
        RuntimeUnavailableError: ``huggingface_hub`` is not installed.
    """
    name, hub = read_name(text), library()
    with told(text):
        folder = _snapshot(hub, name.repository, name.revision, list(_ABOUT))
        if name.inside.endswith(_CHECKPOINT):
            return _fetched(hub, name, text, folder.name, [name.inside])
        try:
            tree = hub.HfApi().list_repo_tree(name.repository, revision=folder.name, recursive=True)
            files = [each.path for each in tree if isinstance(each, hub.hf_api.RepoFile)]
        except Exception:  # no network, of whichever library: what was downloaded before may be enough
            files = [each.relative_to(folder).as_posix() for each in folder.rglob("*") if each.is_file()]
            if not _whole(name, files):
                raise
        return _fetched(hub, name, text, folder.name, _of_checkpoint(name, text, files))


def fetch_recording(text: str) -> Path:
    """The folder with the first episodes of a LeRobot data set: a recording needs few, and some have terabytes.

    Args:
        text: ``hf://datasets/org/name[@revision]``.

    Raises:
        HubError: there is no such data set, it is not LeRobot's, or there is no network and nothing in the cache.
        RuntimeUnavailableError: ``huggingface_hub`` is not installed.
    """
    if not text.startswith(DATA_SETS):
        raise HubError(f"{text:.200}: expected {DATA_SETS}ORGANISATION/NAME, and perhaps @REVISION after it.")
    name, hub = read_name(text.replace(DATA_SETS, HUB)), library()
    with told(text):
        folder = _snapshot(hub, name.repository, name.revision, list(_FIRST_EPISODES), kind="dataset")
    if not (folder / "meta" / "info.json").is_file():
        raise HubError(f"{text}: there is no meta/info.json in it; expected a LeRobot data set.")
    return folder


def _whole(name: HubName, kept: list[str]) -> bool:
    """Whether files in the cache say without a listing what the checkpoint is: a directory of LeRobot does.

    One ``.ckpt`` does not: the repository may have others, which nobody downloaded.
    """
    return any({name.folder + each for each in (*policy, *_PROCESSORS)} <= set(kept) for policy in _POLICIES)


def _of_checkpoint(name: HubName, text: str, files: list[str]) -> list[str]:
    below = [each.removeprefix(name.folder) for each in files if each.startswith(name.folder)]
    if any(policy <= set(below) for policy in _POLICIES):
        return [name.folder + each for each in below if _OF_LEROBOT.fullmatch(each)]
    found = [name.folder + each for each in below if each.endswith(_CHECKPOINT)]
    if len(found) == 1:
        return found
    if found:
        example = next((each.removeprefix(name.folder) for each in found if plain(each)), f"PATH{_CHECKPOINT}")
        raise HubError(f"{text}: it has {len(found)} checkpoints. Say which: {name.at('REVISION')}/{example}")
    has = ", ".join(each for each in files[:4] if plain(each)) or "nothing"
    expected = f"expected {_CONFIG} and {_WEIGHTS} of LeRobot, or one file {_CHECKPOINT} of Diffusion Policy"
    raise HubError(f"{text}: there is no checkpoint in it; {expected}; found {has}.")


def _fetched(hub: Any, name: HubName, text: str, commit: str, chosen: list[str], anew: bool = False) -> Fetched:
    if len(chosen) > MOST_FILES:
        raise HubError(f"{text}: it lists {len(chosen)} files; expected {MOST_FILES} at most.")
    for each in chosen:
        if not plain(each) or not each.endswith(_ENDS):
            raise HubError(f"{text}: {each!r:.200} is no file of an artifact or a checkpoint.")
    # Patterns that are plain names match themselves, and nothing else.
    folder = _snapshot(hub, name.repository, commit, [*_ABOUT, *chosen], anew)
    if missing := [each for each in chosen if not (folder / each).is_file()]:
        raise HubError(f"{text}: {missing[0]} is not there: the repository is not whole.")
    single = len(chosen) == 1 and chosen[0].endswith(_CHECKPOINT)
    return Fetched(folder / (chosen[0] if single else name.inside), name.at(commit), _licence(folder / CARD))


def _snapshot(
    hub: Any, repository: str, revision: str | None, files: list[str], anew: bool = False, kind: str = "model"
) -> Path:
    """The folder of a commit in the cache, which has its name, with these files of those that there are."""
    commit = branch = revision or "main"
    download = partial(hub.snapshot_download, repo_type=kind)
    if not _COMMIT.fullmatch(branch):
        try:
            commit = str(hub.HfApi().repo_info(repository, revision=branch, repo_type=kind).sha)
        except hub.errors.HfHubHTTPError:
            raise
        except Exception:  # no network, of whichever library: the cache may know what it meant
            return Path(download(repository, revision=branch, allow_patterns=files, local_files_only=True))
        if not _COMMIT.fullmatch(commit):  # the library takes it for the name of a folder
            raise HubError(f"{HUB}{repository}: expected a commit of 40 digits from the hub; found {commit!a:.100}.")
    folder = Path(download(repository, revision=commit, allow_patterns=files, force_download=anew))
    if commit != branch:  # as the library does where it is given the branch: what it means where nobody answers
        (ref := folder.parents[1] / "refs" / branch).parent.mkdir(parents=True, exist_ok=True)
        ref.write_text(commit)
    return folder


def _listed(manifest: Path, text: str) -> list[str]:
    """The manifest, and the files that it lists; whether it is one is ``load``'s matter."""
    try:
        if manifest.stat().st_size > MOST_MANIFEST_BYTES:
            raise HubError(f"{text}: {MANIFEST} has more than {MOST_MANIFEST_BYTES:,} bytes, so it is no artifact's.")
        files = parse_json(manifest.read_bytes(), MOST_MANIFEST_BYTES)["files"]
        return [MANIFEST, *map(str, dict(files))]
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise HubError(f"{text}: {MANIFEST} lists no files, so it is no artifact's.") from error


def _licence(card: Path) -> str | None:
    """Of the head of a card, which is YAML between two lines of hyphens."""
    try:
        if card.stat().st_size > MOST_CARD_BYTES:
            return None
        from huggingface_hub import metadata_load

        told = (metadata_load(card) or {}).get("license")
    except Exception:  # of whatever stands there: a card without a head that can be read says no licence
        return None
    return told if isinstance(told, str) and _LICENCE.fullmatch(told) else None


def library() -> Any:
    """The package ``huggingface_hub``.

    Raises:
        RuntimeUnavailableError: it is not installed.
    """
    with needing("the Hugging Face hub", "hub"):
        import huggingface_hub
        import huggingface_hub.errors
        import huggingface_hub.hf_api
    return huggingface_hub


@contextmanager
def told(text: str) -> Iterator[None]:
    """Make one ``HubError`` of whatever the library raises; it begins with what was asked for."""
    try:
        yield
    except TtscompileError:
        raise
    except Exception as error:  # of HTTP, of the file system, of a server's answers
        last: BaseException = error
        while last.__cause__ is not None:
            last = last.__cause__
        kind, first = type(last).__name__, f"{last}".strip().split("\n")[0].rstrip(".")
        remedy = "Is the name right, is there a network, and for a private repository a login (hf auth login)?"
        raise HubError(f"{text:.200}: {kind}: {first:.300}. {remedy}") from error


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
