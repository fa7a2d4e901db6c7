import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.once import Once
from tests.plans import store_schedules
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.ir.program import Program

MakeArtifact = Callable[[Program], Artifact]


class Failure(Exception):
    """Raised by the tests."""


@contextmanager
def failing_prologue(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every runtime fails where a call begins."""
    from ttscompile.runtimes.onnxruntime.workspace import Workspace
    from ttscompile.runtimes.reference.model import ReferenceModel
    from ttscompile.runtimes.torch.network import StreamsNetwork

    def fail(*_: object) -> None:
        raise Failure

    with monkeypatch.context() as patched:
        patched.setattr(Workspace, "start", fail)
        patched.setattr(ReferenceModel, "prologue", fail)
        patched.setattr(StreamsNetwork, "prologue", fail)
        yield


@pytest.fixture(scope="session")
def toy_artifact(toy_compiled: Path) -> Artifact:
    return load_artifact(toy_compiled)


@pytest.fixture(scope="session")
def pencil_artifact(once: Once) -> Artifact:
    from .toys import pencil_program, written_artifact

    return load_artifact(once.folder("pencil", lambda directory: written_artifact(pencil_program(), directory)))


@pytest.fixture
def own_artifact(toy_artifact: Artifact, tmp_path: Path) -> Artifact:
    """A copy of the toy, for tests that change it."""
    return load_artifact(shutil.copytree(toy_artifact.path, tmp_path / "toy"))


@pytest.fixture
def pruned(own_artifact: Artifact) -> Artifact:
    """A toy whose default plan is its pruner's, which has a thread and reads earlier calls."""
    store_schedules(own_artifact.path, dict(own_artifact.pruner), {}, "tts", {"learned": ["schedule"]})
    return load_artifact(own_artifact.path)


@pytest.fixture
def make_artifact(tmp_path: Path) -> MakeArtifact:
    from .toys import written_artifact

    return lambda program: written_artifact(program, tmp_path / "artifact")
