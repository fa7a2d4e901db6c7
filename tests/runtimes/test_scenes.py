"""What pictures and words decide together is computed once, and known by what they are."""

from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.families.cameras import ACTIONS, HORIZON, STEPS
from tests.families.scenes import Obs, act, compile_all, observation, scenes, together
from tests.lower.whole_call import Episode
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.plan import TokenReuse
from ttscompile.errors import ArtifactError
from ttscompile.runtimes.frames import WINDOWS, FrameMemory, FrameWork
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.verification import verify


@pytest.fixture(scope="module")
def compiled(once: Once) -> Path:
    return once.folder("scenes", compile_all)


@pytest.fixture
def policy(compiled: Path) -> CompiledPolicy:
    return ttscompile.load(compiled / "one", seed=0)


def calls(count: int, frames: int) -> list[tuple[tuple[int, int, int], Obs]]:
    """A sequence in which some calls see what the one before saw, and others another picture, words or state."""
    rng, now, made = np.random.default_rng(7), [10, 20, 1, 0], list[tuple[tuple[int, int, int], Obs]]()
    for _ in range(count):
        for place in range(4):
            if rng.random() < 0.35:
                now[place] = int(rng.integers(1, 4)) + 10 * (place == 0) + 20 * (place == 1)
        left, right, word, state = now
        made.append(((left, right, word), observation(left, right, word, state, frames)))
    return made


@pytest.mark.parametrize("name", ["one", "two"])
def test_what_is_remembered_changes_no_bit(compiled: Path, name: str) -> None:
    """Against the same policy that forgets, and against a literal memory of the last scenes by what is shown."""
    own, other = (ttscompile.load(compiled / name, seed=0) for _ in range(2))
    known, counts = OrderedDict[tuple[int, int, int], None](), set()
    for shown, obs in calls(30, 1 + (name == "two")):
        found = act(own, obs)
        expected = (0, 1) if shown in known else (1, 0)
        known[shown] = None
        known.move_to_end(shown)
        while len(known) > WINDOWS:
            known.popitem(last=False)
        assert scenes(own) == expected
        counts.add(expected)
        other.forget_frames()
        np.testing.assert_array_equal(act(other, obs), found)
        assert scenes(other) == (1, 0)
    assert len(counts) == 2


@pytest.mark.parametrize("name", ["one", "two"])
@pytest.mark.parametrize("runtime", ["reference", "torch"])
def test_the_other_runtimes_compute_every_scene_and_agree(compiled: Path, name: str, runtime: str) -> None:
    policy, other = ttscompile.load(compiled / name), ttscompile.load(compiled / name, runtime=runtime)
    for _, obs in calls(6, 1 + (name == "two")):
        np.testing.assert_allclose(act(other, obs), act(policy, obs), rtol=0, atol=1e-5)
        assert scenes(other) == (0, 0)


def test_the_single_file_computes_it_inside(compiled: Path, policy: CompiledPolicy) -> None:
    cells = np.zeros((STEPS, len(policy.info.blocks)), np.int8)
    episode = Episode((compiled / "one.onnx").read_bytes(), 1)
    for obs in (observation(), observation(state=9), observation(word=9)):
        noise = ttscompile.Noise(np.ones((1, HORIZON, ACTIONS), np.float32))
        np.testing.assert_allclose(episode.call(obs, noise, cells)["action_pred"], act(policy, obs), rtol=0, atol=1e-5)


def test_the_language_model_does_not_run_for_another_state(
    compiled: Path, policy: CompiledPolicy, monkeypatch: Any
) -> None:
    ran = counting(policy, monkeypatch)
    act(policy, observation(state=0))
    found = act(policy, observation(state=1))
    assert (len(ran), scenes(policy)) == (1, (0, 1))
    fresh = ttscompile.load(compiled / "one")
    np.testing.assert_array_equal(act(fresh, observation(state=1)), found)
    act(policy, observation(state=1, word=5))
    assert len(ran) == 2


@pytest.mark.parametrize("name", ["one", "two"])
def test_each_stream_has_a_scene_of_its_own(compiled: Path, name: str) -> None:
    policy, count = ttscompile.load(compiled / name, seed=0), 1 + (name == "two")
    streams = [observation(left=i, right=2 * i, state=i, frames=count) for i in range(3)]
    act(policy, together(*streams))
    assert scenes(policy) == (3, 0)
    streams[1] = observation(left=1, right=7, state=8, frames=count)
    streams[2] = {**streams[2], "state": streams[2]["state"] + 1}
    found = act(policy, together(*streams))
    assert scenes(policy) == (1, 2)
    policy.forget_frames()
    np.testing.assert_array_equal(act(policy, together(*streams)), found)
    policy.reset()
    for i, obs in enumerate(streams):
        np.testing.assert_allclose(act(policy, obs), found[i : i + 1], rtol=0, atol=1e-5)
    policy.reset()
    act(policy, together(streams[0], streams[0]))
    assert scenes(policy) == (1, 1), "two streams that see the same have one"


@pytest.mark.parametrize("forget", ["reset", "forget_frames"])
def test_a_scene_is_forgotten(policy: CompiledPolicy, forget: str) -> None:
    act(policy, observation())
    getattr(policy, forget)()
    act(policy, observation())
    assert scenes(policy) == (1, 0)


def test_what_it_took_is_told(policy: CompiledPolicy) -> None:
    act(policy, observation())
    report = policy.last_report
    assert report is not None
    assert report.frames.waited == report.timings.frames > 0
    act(policy, observation())
    report = policy.last_report
    assert report is not None
    assert (report.frames.waited, report.frames.remembered) == (0, 2)
    assert report.frames.saved > 0


def test_a_scene_that_fails_ends_the_call_and_leaves_nothing(policy: CompiledPolicy, monkeypatch: Any) -> None:
    backend: Any = policy._runtime.backend
    expected = act(policy, observation())
    policy.reset()

    class Failing:
        def run(self, outputs: list[str], feed: Obs) -> None:
            raise RuntimeError("scripted")

    with monkeypatch.context() as patch:
        patch.setitem(backend.sessions, "scene", Failing())
        with pytest.raises(ArtifactError, match="scripted"):
            act(policy, observation())
    np.testing.assert_array_equal(act(policy, observation()), expected)
    assert scenes(policy) == (1, 0)


def test_memory_is_bounded(policy: CompiledPolicy) -> None:
    for number in range(6):
        act(policy, observation(left=number))
    memory: Any = policy._runtime._used.frames._memory
    assert len(memory["scene"]) == WINDOWS


def test_a_frame_prepared_ahead_computes_no_scene(policy: CompiledPolicy) -> None:
    frame = {key: value[:, 0] if key in ("left", "right") else value for key, value in observation().items()}
    work = policy.prepare_frame(frame)
    assert (work.computed, work.scenes) == (2, 0)
    act(policy, observation())
    assert scenes(policy) == (1, 0)


def test_where_tokens_are_reused_a_scene_stands_until_a_token_is_computed(compiled: Path) -> None:
    artifact = load_artifact(compiled / "tokens")
    policy = ttscompile.load(compiled / "tokens", seed=0)
    plan = replace(artifact.plan("dense"), tokens=TokenReuse(threshold=0.05, refresh=3))
    first, told = observation(), list[tuple[int, int]]()
    for change in (0.0, 0.001, 0.0, 0.5, 0.5, 0.5005):
        obs = {key: value.copy() for key, value in first.items()}
        obs["left"][..., :4, :4] += np.float32(change)
        obs["state"] += np.float32(change)
        act(policy, obs, plan)
        told.append(scenes(policy))
    # Nothing that a patch shows has changed by enough: the result is the same object, and so is the scene. The last one
    # is the third new frame since all tokens were computed.
    assert told == [(1, 0), (0, 1), (0, 1), (1, 0), (0, 1), (1, 0)]


def test_results_with_equal_numbers_are_two() -> None:
    memory = FrameMemory()

    def zeros(i: int) -> tuple[tuple[Any, ...], FrameWork]:
        return (np.zeros((1, 2)),), FrameWork()

    memory.learn([(b"one",), (b"other",)], zeros)
    one, other = memory.results([(b"one",), (b"other",)])
    assert one != other
    assert one == memory.results([(b"one",)])[0]


@pytest.mark.slow
def test_every_rung_of_verify_holds(compiled: Path) -> None:
    result = verify(compiled / "one")
    assert result.passed, result


def counting(policy: CompiledPolicy, monkeypatch: Any) -> list[None]:
    """One entry for each time that the piece ``scene`` runs from here on."""
    backend: Any = policy._runtime.backend
    own, ran = backend.sessions["scene"], list[None]()

    class Counted:
        def run(self, outputs: list[str], feed: Obs) -> Any:
            ran.append(None)
            return own.run(outputs, feed)

    monkeypatch.setitem(backend.sessions, "scene", Counted())
    return ran
