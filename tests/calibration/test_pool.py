"""Parts of a calibration on other processes: the same bits, a death on the way, and a cluster that goes."""

import importlib.util
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import ttscompile
from ttscompile.calibration import pipeline
from ttscompile.errors import ClusterError, RuntimeUnavailableError
from ttscompile.pool import Here, RayPool, Work

from .pools import Elsewhere, needs_ray

SEARCH: dict[str, Any] = {"target_sparsity": 0.7, "max_intervals": 6, "progress": False}


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "manifest.json"}


def identity(folder: Path) -> str:
    return ttscompile.load(folder).info.identity


@pytest.mark.parametrize(
    ("said", "told"), [("The current node timed out during startup.\nMore.", "The current node .*"), ("", "Exception")]
)
def test_a_cluster_that_does_not_start_is_one_error(monkeypatch: pytest.MonkeyPatch, said: str, told: str) -> None:
    """Ray raises a bare Exception where a node takes too long, as on a busy machine."""

    def init(**options: Any) -> None:
        raise Exception(said)

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init))
    with pytest.raises(ClusterError, match=rf"no cluster can be reached \({told}\)\. Start it"):
        RayPool("local")


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Callable[[Elsewhere], None]:
    """Puts a pool in the place of the one at an address."""

    def put(pool: Elsewhere) -> None:
        @contextmanager
        def opened(address: str | None) -> Iterator[Elsewhere | Here]:
            yield Here() if address is None else pool

        monkeypatch.setattr(pipeline, "opened_pool", opened)

    return put


@pytest.fixture(scope="module")
def alone(compiled: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What this process makes of it without a pool."""
    folder = Path(shutil.copytree(compiled, tmp_path_factory.mktemp("alone") / "compiled"))
    ttscompile.calibrate(folder, [recording], **SEARCH)
    return folder


@pytest.mark.slow
def test_parts_that_are_given_at_once_give_the_same_bytes(
    artifact: Path, recording: Path, alone: Path, cluster: Callable[[Elsewhere], None]
) -> None:
    """The search looks ahead: five candidates at once, of which some are asked for in vain."""
    pool = Elsewhere(5)
    cluster(pool)
    ttscompile.calibrate(artifact, [recording], **SEARCH, ray="an address")
    assert pool.done > 20
    assert content(artifact) == content(alone)
    assert identity(artifact) == identity(alone)


@pytest.mark.slow
@pytest.mark.parametrize("lasts", [0, 17])
def test_a_cluster_that_goes_leaves_a_state_from_which_this_process_goes_on(
    lasts: int, artifact: Path, recording: Path, alone: Path, cluster: Callable[[Elsewhere], None]
) -> None:
    before = identity(artifact)
    cluster(Elsewhere(3, lasts))
    with pytest.raises(ClusterError, match="is gone"):
        ttscompile.calibrate(artifact, [recording], **SEARCH, ray="an address")
    assert identity(artifact) == before
    cluster(Elsewhere(0, 0))
    ttscompile.calibrate(artifact, [recording], **SEARCH, resume=True)
    assert content(artifact) == content(alone)


def test_another_artifact_on_a_machine_of_the_cluster_is_refused(artifact: Path, tmp_path: Path) -> None:
    from ttscompile.pool import artifact_elsewhere

    with pytest.raises(ttscompile.errors.CalibrationError, match="has another artifact there"):
        artifact_elsewhere(str(artifact), "another")
    with pytest.raises(ttscompile.errors.CalibrationError, match="under the same path: use a shared folder"):
        artifact_elsewhere(str(tmp_path / "none"), "another")


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="Ray is installed")
def test_without_ray_it_is_said_how_to_install_it(artifact: Path, recording: Path) -> None:
    with pytest.raises(RuntimeUnavailableError, match=r"pip install 'ttscompile\[ray\]'"):
        ttscompile.calibrate(artifact, [recording], ray="local")


@pytest.fixture(scope="module")
def ray_pool() -> Iterator[RayPool]:
    with RayPool("local", cores=2) as pool:
        yield pool


@needs_ray
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_ray_gives_the_same_bytes(
    ray_pool: RayPool, artifact: Path, recording: Path, alone: Path, cluster: Callable[[Any], None]
) -> None:
    cluster(ray_pool)
    ttscompile.calibrate(artifact, [recording], **SEARCH, ray="an address")
    assert content(artifact) == content(alone)


def dies_once(folder: str) -> Callable[[int], int]:
    def run(part: int) -> int:
        marker = Path(folder, str(part))
        if part == 1 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return 10 * part

    return run


def dies(folder: str) -> Callable[[int], int]:
    def run(part: int) -> int:
        os.kill(os.getpid(), signal.SIGKILL)
        return part

    return run


@needs_ray
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_part_whose_process_dies_is_begun_again_and_not_for_ever(ray_pool: RayPool, tmp_path: Path) -> None:
    assert list(ray_pool.map(Work(int, dies_once, (str(tmp_path),)), [0, 1, 2])) == [0, 10, 20]
    assert (tmp_path / "1").exists()
    with pytest.raises(ClusterError, match="--resume goes on"):
        list(ray_pool.map(Work(int, dies, (str(tmp_path),)), [0]))
