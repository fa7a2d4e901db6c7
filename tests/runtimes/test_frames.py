"""Frames are computed once, and known by their content."""

import gc
from pathlib import Path
from typing import Any
from weakref import ref

import numpy as np
import numpy.typing as npt
import pytest

import ttscompile
from tests.families import cameras
from tests.lower.whole_call import Episode
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.errors import ArtifactError, ObservationError
from ttscompile.runtimes.frames import WINDOWS, FrameMemory, FrameWork, contents_of
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.verification import verify
from ttscompile.verification.reuse import ENGAGED

Array = npt.NDArray[Any]
Obs = dict[str, Array]


@pytest.fixture(scope="module")
def compiled(once: Once) -> Path:
    return once.folder("seeing", cameras.compile_seeing)


@pytest.fixture
def policy(compiled: Path) -> CompiledPolicy:
    return ttscompile.load(compiled / "artifact", seed=0)


def frame(number: int, word: int = 1) -> Obs:
    rng = np.random.default_rng(number)
    images = {key: rng.random((1, 3, cameras.SIDE, cameras.SIDE), dtype=np.float32) for key in cameras.CAMERAS}
    words = {"tokens": np.full((1, cameras.WORDS), word), "mask": np.ones((1, cameras.WORDS), np.bool_)}
    return {**images, "state": rng.random((1, 4), dtype=np.float32), **words}


def window(*frames: Obs) -> Obs:
    specs = cameras.policy("shared", told=True)[1].observations
    return {
        key: np.stack([one[key] for one in frames], 1) if spec.frames else frames[-1][key]
        for key, spec in specs.items()
    }


def noise(number: int = 0) -> ttscompile.Noise:
    shape = (1, cameras.HORIZON, cameras.ACTIONS)
    return ttscompile.Noise(np.random.default_rng(number).standard_normal(shape, dtype=np.float32))


def act(policy: CompiledPolicy, obs: Obs) -> Array:
    return np.asarray(policy.predict_action(obs, noise=noise())["action_pred"])


def done(policy: CompiledPolicy) -> tuple[int, int]:
    """Frames that the last call computed, and that were known."""
    assert policy.last_report is not None
    return policy.last_report.frames.computed, policy.last_report.frames.remembered


@pytest.mark.slow
def test_only_new_frames_are_computed(policy: CompiledPolicy) -> None:
    act(policy, window(frame(0), frame(1)))
    assert done(policy) == (5, 0)  # two frames of two cameras, and the instruction
    act(policy, window(frame(1), frame(2)))
    assert done(policy) == (2, 3)
    act(policy, window(frame(2), {**frame(3), "left": frame(2)["left"]}))
    assert done(policy) == (1, 4), "a camera whose picture did not change costs nothing"
    act(policy, window(frame(2), {**frame(3, word=2), "left": frame(2)["left"]}))
    assert done(policy) == (1, 4), "another instruction alone"
    act(policy, window(frame(4), frame(4)))
    assert done(policy) == (2, 3), "a frame that came twice is one, and the instruction of before is still known"
    assert policy.info.frames == 2


@pytest.mark.slow
def test_what_is_remembered_changes_no_bit(policy: CompiledPolicy) -> None:
    windows = [window(frame(i), frame(i + 1)) for i in (0, 1, 0, 3)]
    going_on = [act(policy, obs) for obs in windows]
    for obs, found in zip(windows, going_on, strict=True):
        policy.reset()
        np.testing.assert_array_equal(act(policy, obs), found)
        assert done(policy) == (5, 0), "reset forgets"


@pytest.mark.parametrize("runtime", ["reference", "torch"])
def test_the_other_runtimes_compute_every_frame_and_agree(compiled: Path, runtime: str, policy: CompiledPolicy) -> None:
    other = ttscompile.load(compiled / "artifact", runtime=runtime)
    assert other.info.frames == 0
    for i in (0, 1):
        obs = window(frame(i), frame(i + 1))
        np.testing.assert_allclose(act(other, obs), act(policy, obs), rtol=0, atol=1e-5)
        assert done(other) == (0, 0)
    assert other.prepare_frame(frame(2)).computed == 0


def test_the_single_file_computes_them_inside(compiled: Path, policy: CompiledPolicy) -> None:
    obs, cells = window(frame(0), frame(1)), np.zeros((cameras.STEPS, len(policy.info.blocks)), np.int8)
    found = Episode((compiled / "whole.onnx").read_bytes(), 1).call(obs, noise(), cells)["action_pred"]
    np.testing.assert_allclose(found, act(policy, obs), rtol=0, atol=1e-5)


def test_several_streams(policy: CompiledPolicy) -> None:
    both = [window(frame(0), frame(1)), window(frame(1), frame(2))]
    stacked = {key: np.concatenate([one[key] for one in both]) for key in both[0]}
    initial = np.repeat(noise().initial, 2, 0)
    made = policy.predict_action(stacked, noise=ttscompile.Noise(initial))["action_pred"]
    assert done(policy) == (7, 3), "streams share the frames that they have in common, and their instruction"
    policy.reset()
    for i, obs in enumerate(both):
        np.testing.assert_allclose(act(policy, obs), made[i : i + 1], rtol=0, atol=1e-5)


def test_a_frame_prepared_before_its_call_is_known(policy: CompiledPolicy) -> None:
    assert policy.prepare_frame(frame(0)).computed == 3
    act(policy, window(frame(0), frame(1)))
    assert done(policy) == (2, 3)
    report = policy.last_report
    assert report is not None
    assert report.timings.frames == report.frames.waited > 0
    assert report.frames.saved > 0
    assert report.timings.frames < report.timings.prologue


def test_preparing_changes_nothing_that_comes_out(policy: CompiledPolicy) -> None:
    obs = window(frame(0), frame(1))
    expected = act(policy, obs)
    policy.reset()
    for number in (5, 0, 1, 6):  # others, late and out of order
        policy.prepare_frame(frame(number))
    np.testing.assert_array_equal(act(policy, obs), expected)


def test_preparing_ends_where_it_is_told(policy: CompiledPolicy) -> None:
    asked: list[bool] = []

    def second() -> bool:
        asked.append(len(asked) == 1)
        return asked[-1]

    work = policy.prepare_frame(frame(0), second)
    assert (work.computed, asked[:2]) == (1, [False, True])
    act(policy, window(frame(0), frame(1)))
    assert done(policy) == (4, 1), "the rest is left to the call"


def test_a_wrong_frame_is_refused_and_nothing_is_kept(policy: CompiledPolicy) -> None:
    with pytest.raises(ObservationError, match="wrong shape"):
        policy.prepare_frame(window(frame(0), frame(1)))
    act(policy, window(frame(0), frame(1)))
    assert done(policy) == (5, 0)


def test_a_frame_of_another_number_of_streams_is_refused_within_an_episode(policy: CompiledPolicy) -> None:
    two = {key: np.concatenate([value, value]) for key, value in frame(3).items()}
    policy.prepare_frame(two)
    act(policy, window(frame(0), frame(1)))
    with pytest.raises(ObservationError, match=r"2 streams, and the episode under way 1. Call reset\(\)"):
        policy.prepare_frame(two)
    policy.reset()
    assert policy.prepare_frame(two).computed


def test_a_piece_that_fails_ends_the_call_and_leaves_nothing(policy: CompiledPolicy, monkeypatch: Any) -> None:
    backend: Any = policy._runtime.backend
    obs = window(frame(0), frame(1))
    expected = act(policy, obs)
    policy.reset()
    own, count = backend.sessions["frame_01"], [0]

    class Failing:
        def run(self, outputs: list[str], feed: Obs) -> list[Array]:
            count[0] += 1
            if count[0] == 2:
                raise RuntimeError("scripted")
            return list(own.run(outputs, feed))

    monkeypatch.setitem(backend.sessions, "frame_01", Failing())
    with pytest.raises(ArtifactError, match="scripted"):
        act(policy, obs)
    np.testing.assert_array_equal(act(policy, obs), expected)
    assert done(policy)[0] < 5, "what was computed before the failure is right, and stays"


def test_a_policy_that_nobody_holds_gives_its_memory_back_at_once(compiled: Path) -> None:
    """Its sessions hold all weights; a collector that comes some time later has them twice."""
    opened = ttscompile.load(compiled / "artifact", seed=0)
    act(opened, window(frame(1), frame(2)))
    backend = ref(opened._runtime.backend)
    gc.disable()
    try:
        del opened
        assert backend() is None
    finally:
        gc.enable()


def test_memory_is_bounded(policy: CompiledPolicy) -> None:
    for number in range(12):
        act(policy, window(frame(number), frame(number + 1)))
        policy.prepare_frame(frame(number + 50))
    memory: Any = policy._runtime._used.frames._memory
    assert sorted(len(one) for one in memory.values()) == [1, WINDOWS * 4]


def test_frames_that_differ_in_one_number_are_two() -> None:
    memory, asked = FrameMemory(), list[float]()

    def double(i: int) -> tuple[tuple[Any, ...], FrameWork]:
        asked.append(float(rows[i].sum()))
        return (2 * rows[i : i + 1],), FrameWork()

    rows = np.zeros((3, 4), np.float32)
    rows[1, 2], rows[2, 2] = np.float32(1e-30), np.float32(-0.0)
    contents = contents_of([rows])
    memory.learn(contents, double)
    np.testing.assert_array_equal(memory.values(contents)[0], 2 * rows)
    assert len(asked) == 3


def test_measuring_counts_every_frame(policy: CompiledPolicy) -> None:
    obs = window(frame(0), frame(1))
    act(policy, obs)
    policy.forget_frames()
    act(policy, obs)
    assert done(policy) == (5, 0)


def test_select_action_remembers(policy: CompiledPolicy) -> None:
    for number in range(4):  # chunks of two actions
        policy.select_action(frame(number))
    assert done(policy)[1] == 1, "frames 1 and 2 are new; the instruction is not"
    policy.reset()
    policy.select_action(frame(0))
    assert done(policy) == (3, 2), "the first frame fills the window"


def test_every_rung_of_verify_holds(compiled: Path) -> None:
    found = verify(compiled / "artifact")
    assert {rung.name: rung.status for rung in found.rungs if rung.status not in ("passed", "skipped")} == {}
    assert sum(rung.status == "passed" for rung in found.rungs) >= 6


@pytest.mark.slow
def test_towers_in_eight_bits(tmp_path: Path) -> None:
    """A tower has a precision of its own; a remembered frame has the bits that it would have again."""
    ttscompile.compile_denoiser(*cameras.policy("shared", told=True), tmp_path / "int8", precision="int8")
    policy, exact = ttscompile.load(tmp_path / "int8"), ttscompile.load(tmp_path / "int8", plan="dense")
    record = load_artifact(tmp_path / "int8").manifest.precision
    assert record is not None
    assert set(record.kept) == {"blocks", "frame_00"}  # the convolutions of these cameras are too small
    first, second = frame(1), frame(2)
    act(policy, window(first, first))
    remembered = act(policy, window(first, second))
    assert done(policy)[1] > 0
    policy.reset()
    np.testing.assert_array_equal(act(policy, window(first, second)), remembered)
    wanted = act(exact, window(first, second))
    assert 0 < np.abs(remembered - wanted).max() < 0.1 * np.abs(wanted).max()
    assert {rung.status for rung in verify(tmp_path / "int8").rungs if rung.name != ENGAGED} <= {"passed", "skipped"}
