"""A policy is wholly what its identity says, whatever is done to the artifact while it is loaded and after."""

import gc
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

import ttscompile
from tests.plans import store_schedules
from ttscompile.artifact import files, load_artifact
from ttscompile.artifact.files import beside, exchange, replace_folder
from ttscompile.artifact.golden import load_golden_plans
from ttscompile.artifact.load import read_manifest
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.errors import ArtifactChangedError, ArtifactError
from ttscompile.runtimes import load as loading, open as opening
from ttscompile.runtimes.onnxruntime import sessions

from .replaced import CHANGES, COMMANDS, answer, load_often, prepared, prepared_by_commands, reuse
from .toys import toy_program, written_artifact
from .unloaded import left


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two artifacts of one shape with other weights."""
    folder = tmp_path_factory.mktemp("both")
    one, other = (written_artifact(toy_program(seed=seed), folder / str(seed)).path for seed in (0, 1))
    return one, other


@pytest.fixture
def places(both: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    """Copies of the two: the one that is loaded, and the one that takes its place."""
    one, other = (Path(shutil.copytree(path, tmp_path / name)) for path, name in zip(both, "ab", strict=True))
    return one, other


@pytest.fixture(scope="module")
def expected(both: tuple[Path, Path]) -> dict[str, bytes]:
    return {read_manifest(path).identity: answer(ttscompile.load(path), read_manifest(path).spec) for path in both}


def is_whole(loaded: ttscompile.CompiledPolicy, expected: dict[str, bytes], path: Path) -> bool:
    return expected[loaded.info.identity] == answer(loaded, read_manifest(path).spec)


Swap = Callable[[], object]


@contextmanager
def around_sessions(monkeypatch: pytest.MonkeyPatch, before: Swap, after: Swap = lambda: None) -> Iterator[None]:
    """Something happens between the checks and the opening of what was checked, and right after."""

    def opened(artifact: object, *options: object) -> object:
        before()
        try:
            return opening.open_runtime(artifact, *options)  # type: ignore[arg-type]
        finally:
            after()

    with monkeypatch.context() as patched:
        patched.setattr(loading, "open_runtime", opened)
        yield


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
@pytest.mark.parametrize("there_and_back", [False, True])
def test_exchanged_between_check_and_use(
    places: tuple[Path, Path],
    expected: dict[str, bytes],
    monkeypatch: pytest.MonkeyPatch,
    runtime: str,
    there_and_back: bool,
) -> None:
    if runtime != "onnxruntime":  # whose sums are rounded otherwise
        found = ttscompile.load(places[0], runtime)
        expected = {found.info.identity: answer(found, read_manifest(places[0]).spec)}

    def swap() -> None:
        assert exchange(*places)

    with around_sessions(monkeypatch, swap, swap if there_and_back else lambda: None):
        loaded = ttscompile.load(places[0], runtime)
    assert is_whole(loaded, expected, places[1])
    # The lazily opened ones are its own too.
    assert exchange(*places)
    partial = uniform_plan(5, 5, 3)
    partial[4, 2] = Source.COMPUTE
    loaded.predict_action(_observation(places[0]), plan=partial)


def _observation(path: Path) -> dict[str, np.ndarray]:
    specs = read_manifest(path).spec.observations
    return {key: np.zeros((1, *spec.shape), spec.dtype) for key, spec in specs.items()}


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_converted_again_between_check_and_use_gives_the_new_one(
    places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, runtime: str
) -> None:
    """The old folder is gone with all its files; ``load`` begins again."""

    def convert() -> None:
        if places[1].exists():
            replace_folder(places[1], places[0])

    wanted = read_manifest(places[1]).identity
    with around_sessions(monkeypatch, convert):
        loaded = ttscompile.load(places[0], runtime)
    assert loaded.info.identity == wanted
    loaded.predict_action(_observation(places[0]))


def test_replaced_at_every_try_is_an_error_that_says_so(
    places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def convert() -> None:
        replace_folder(Path(shutil.copytree(places[1], beside(places[0]))), places[0])

    with (
        around_sessions(monkeypatch, convert),
        pytest.raises(ArtifactChangedError, match=rf"^{places[0]}: the artifact was replaced or changed .* again"),
    ):
        ttscompile.load(places[0])


def test_replaced_after_load_single_blocks_are_refused(places: tuple[Path, Path]) -> None:
    loaded = ttscompile.load(places[0])
    whole, partial = uniform_plan(5, 5, 3), uniform_plan(5, 5, 3)
    partial[4, 2] = Source.COMPUTE
    replace_folder(places[1], places[0])
    with pytest.raises(ArtifactChangedError, match="since it was loaded"):
        loaded.predict_action(_observation(places[0]), plan=partial)
    loaded.reset()
    loaded.predict_action(_observation(places[0]), plan=whole)


@pytest.mark.parametrize("name", ["weights.safetensors", "dense_step.onnx"])
def test_written_in_place_between_check_and_use(
    places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    content = (places[1] / name).read_bytes()
    assert len(content) == (places[0] / name).stat().st_size
    with (
        around_sessions(monkeypatch, lambda: (places[0] / name).write_bytes(content)),
        pytest.raises(ArtifactError, match=rf"^{places[0]}/{name}: expected sha256"),
    ):  # of the second try: the first one saw that it was changed
        ttscompile.load(places[0])


def test_written_in_place_while_sessions_open(places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """There and back: the bytes are right before and after, and what onnxruntime read is not."""
    path, session = places[0] / "weights.safetensors", onnxruntime.InferenceSession
    right, wrong = path.read_bytes(), (places[1] / path.name).read_bytes()

    def opened(*args: Any, **options: Any) -> Any:
        path.write_bytes(wrong)
        made = session(*args, **options)
        path.write_bytes(right)
        return made

    monkeypatch.setattr(onnxruntime, "InferenceSession", opened)
    monkeypatch.setattr(loading, "TRIES", 1)
    with pytest.raises(ArtifactChangedError):
        ttscompile.load(places[0])


def test_what_is_read_later_is_what_was_checked(places: tuple[Path, Path]) -> None:
    """``program.json``, which only the reference runtime reads, and the golden records."""
    reuse(places[0], 1)
    kept, gone = load_artifact(places[0]), load_artifact(places[1])
    program = places[0] / "program.json"
    content = program.read_bytes()
    assert exchange(*places)
    assert kept.graphs
    assert load_golden_plans(kept, 1) == {}
    assert exchange(*places)
    program.write_bytes(content.replace(b"float32", b"float64", 1))
    with pytest.raises(ArtifactError, match=rf"^{program}: expected sha256"):
        _ = load_artifact(places[0])
    shutil.rmtree(places[1])
    with pytest.raises(ArtifactChangedError, match="replaced or changed"):
        _ = gone.graphs


def test_a_calibration_while_the_artifact_is_loaded(places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """The files of the old plans are gone; ``load`` begins again, and has the new ones."""
    reuse(places[0], 1)

    def calibrate() -> None:
        if "second" not in read_manifest(places[0]).plans:
            plan = uniform_plan(5, 5, 2)
            store_schedules(places[0], None, {"second": plan}, "second", {})

    with around_sessions(monkeypatch, calibrate):
        assert ttscompile.load(places[0]).info.default_plan == "second"


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_without_proc_exchanged_there_and_back_is_seen(
    places: tuple[Path, Path], expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, runtime: str
) -> None:
    """As on macOS: what was opened by name in between is the other's, and nothing of it is used."""
    monkeypatch.setattr(files, "HELD", str(places[0] / "none"))
    assert ttscompile.load(places[0], runtime).info.identity in expected
    monkeypatch.setattr(loading, "TRIES", 1)

    def swap() -> None:
        assert exchange(*places)

    with around_sessions(monkeypatch, swap), pytest.raises(ArtifactError, match=r"expected sha256|was replaced"):
        ttscompile.load(places[0], runtime)
    swap()
    session = onnxruntime.InferenceSession

    def opened(*args: Any, **options: Any) -> Any:
        swap()
        made = session(*args, **options)
        swap()
        return made

    if runtime == "onnxruntime":
        monkeypatch.setattr(onnxruntime, "InferenceSession", opened)
        with pytest.raises(ArtifactChangedError):
            ttscompile.load(places[0], runtime)


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_nothing_of_a_small_artifact_is_mapped(
    places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, runtime: str
) -> None:
    """What is written in place, which empties a file first, would end a process that reads it by a map."""

    def none_is_mapped() -> None:
        assert str(places[0]) not in Path("/proc/self/maps").read_text()

    with around_sessions(monkeypatch, none_is_mapped, none_is_mapped):
        loaded = ttscompile.load(places[0], runtime)
    right = answer(loaded, read_manifest(places[1]).spec)
    none_is_mapped()
    for path in places[0].iterdir():
        path.write_bytes(b"")
    assert answer(loaded, read_manifest(places[1]).spec) == right


def test_an_artifact_with_a_large_file_beside_small_ones_is_loaded(
    places: tuple[Path, Path], expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """onnxruntime is given all files that models name, or none."""
    monkeypatch.setattr(sessions, "MAPPED", (places[0] / "weights.safetensors").stat().st_size)
    assert is_whole(ttscompile.load(places[0]), expected, places[0])


@pytest.mark.slow
@pytest.mark.parametrize("way", CHANGES)
def test_loads_while_another_process_changes_the_artifact(way: str, tmp_path: Path) -> None:
    """A short version of ``replaced.py``."""
    made = load_often(*prepared(tmp_path), loads=20, ways=[way], longest=0.03)
    assert made["mixed"] == 0, made
    assert sum(made.values()) == 20


@pytest.mark.soak
def test_ten_thousand_loads(tmp_path: Path) -> None:
    made = load_often(*prepared(tmp_path), loads=10_000, ways=CHANGES, longest=0.05)
    assert made["mixed"] == 0, made


@pytest.mark.soak
def test_loads_while_commands_change_the_artifact(tmp_path: Path) -> None:
    made = load_often(*prepared_by_commands(tmp_path), loads=10**6, ways=[COMMANDS], longest=0.05, seconds=60)
    assert made["mixed"] == 0, made


@pytest.mark.slow
def test_a_policy_that_is_let_go_leaves_no_descriptor(places: tuple[Path, Path]) -> None:
    """A short version of ``unloaded.py``, where 5,000 loads leave as much as 500."""
    ttscompile.load(places[0])
    gc.collect()
    before = left()["descriptors"]
    for _ in range(3):
        ttscompile.load(places[0])
    gc.collect()
    assert left()["descriptors"] == before
