"""Calls that begin with the chunk of the call before, against the two loops on their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from tests.once import Once
from ttscompile import Noise
from ttscompile.cli import main
from ttscompile.errors import (
    ArtifactError,
    CalibrationError,
    ExecutorError,
    IllegalPlanError,
    ObservationError,
    TtscompileError,
)
from ttscompile.runtimes.policy import CompiledPolicy

STEPS, LAST, EXECUTED = 8, 3, 8
SHAPE = (2, 16, 2)


@pytest.fixture(scope="module")
def loops(one_layer_checkpoint: Path, once: Once) -> tuple[Path, Path]:
    """The whole loop, of a sampler that draws noise, and its last steps."""

    def convert(name: str, **options: Any) -> Path:
        given = {"sampler": "ddpm", "steps": STEPS, **options}
        return once.compiled(f"warm {name}", lambda path: ttscompile.convert(one_layer_checkpoint, path, **given))[0]

    return convert("whole"), convert("rest", last_steps=LAST)


@pytest.fixture(params=["onnxruntime", "torch", "reference"])
def policies(request: pytest.FixtureRequest, loops: tuple[Path, Path]) -> tuple[CompiledPolicy, ...]:
    """Both in one, the whole loop alone, and the rest alone."""
    whole, rest = loops
    runtime = request.param
    warm = ttscompile.load(whole, runtime, seed=0, warm=rest)
    return warm, ttscompile.load(whole, runtime), ttscompile.load(rest, runtime)


@pytest.fixture
def warm(loops: tuple[Path, Path]) -> CompiledPolicy:
    return ttscompile.load(loops[0], seed=0, warm=loops[1])


def drawn(call: int, streams: int = 2) -> tuple[dict[str, Any], Noise]:
    rng = np.random.default_rng(call)
    obs = rng.uniform(100, 400, (streams, 2, 20)).astype(np.float32)
    shape = (streams, *SHAPE[1:])
    return {"obs": obs}, Noise(
        rng.standard_normal(shape, dtype=np.float32), rng.standard_normal((STEPS, *shape), dtype=np.float32)
    )


def continued(policy: CompiledPolicy, rest: CompiledPolicy, before: Any, noise: Noise) -> Noise:
    """What the rest is given after actions ``before``."""
    start = rest._artifact.manifest.spec.start
    assert start is not None
    assert noise.steps is not None
    normalizer = policy.info.action.normalizer
    assert normalizer is not None
    actions = np.concatenate([before[:, EXECUTED:], np.repeat(before[:, -1:], EXECUTED, 1)], 1)
    initial = start.action * normalizer.normalize(actions) + start.noise * noise.initial
    return Noise(initial.astype(np.float32), noise.steps[STEPS - LAST :])


def test_calls_after_the_first_are_the_rest_of_the_loop(policies: tuple[CompiledPolicy, ...]) -> None:
    both, whole, rest = policies
    for _ in range(2):  # an episode, and one more
        both.reset()
        obs, noise = drawn(0)
        made = both.predict_action(obs, noise)["action_pred"]
        np.testing.assert_allclose(made, whole.predict_action(obs, noise)["action_pred"], atol=1e-3)
        for call in (1, 2):
            obs, noise = drawn(call)
            expected = rest.predict_action(obs, continued(whole, rest, made, noise))["action_pred"]
            made = both.predict_action(obs, noise)["action_pred"]
            np.testing.assert_allclose(made, expected, atol=0.01)  # px, of 512: the normaliser there and back
            report = both.last_report
            assert report is not None
            assert report.plan.shape[1] == LAST


def test_it_says_what_it_is(warm: CompiledPolicy, loops: tuple[Path, Path]) -> None:
    whole, rest = (ttscompile.load(path).info for path in loops)
    assert (warm.info.warm_steps, whole.warm_steps, rest.K) == (LAST, None, LAST)
    assert len(warm.info.identity) == len(whole.identity)
    assert warm.info.identity not in (whole.identity, rest.identity)
    assert warm.info.K == STEPS


def test_actions_one_by_one_begin_chunks_in_turn(warm: CompiledPolicy, loops: tuple[Path, Path]) -> None:
    again = ttscompile.load(loops[0], seed=0, warm=loops[1])
    rng = np.random.default_rng(5)
    frames = rng.uniform(100, 400, (EXECUTED + 1, 2, 20)).astype(np.float32)
    one_by_one = [warm.select_action({"obs": frame}) for frame in frames]
    first = again.predict_action({"obs": np.stack([frames[0]] * 2, 1)})["action"]
    second = again.predict_action({"obs": np.stack([frames[-2], frames[-1]], 1)})["action"]
    np.testing.assert_array_equal(np.stack(one_by_one, 1), np.concatenate([first, second[:, :1]], 1))


def test_a_refused_call_leaves_the_chunk_and_one_that_fails_ends_the_episode(
    warm: CompiledPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    (obs, noise), (later, fresh) = drawn(0), drawn(1)
    warm.predict_action(obs, noise)
    expected = warm.predict_action(later, fresh)["action"]
    warm.reset()
    warm.predict_action(obs, noise)
    with pytest.raises(ObservationError, match=r"holds 1 streams, and the episode under way 2.*reset"):
        warm.predict_action(*drawn(1, streams=1))
    with pytest.raises(IllegalPlanError, match="no plan 'fast'|expected the name of a plan"):
        warm.predict_action(later, fresh, plan="fast")
    with pytest.raises(ObservationError, match=r"noise.initial must be float32"):
        warm.predict_action(later, Noise(fresh.initial[:, :3], fresh.steps))
    with pytest.raises(ObservationError, match=r"obs"):
        warm.predict_action({"obs": later["obs"] * np.float32(np.nan)}, fresh)
    np.testing.assert_array_equal(warm.predict_action(later, fresh)["action"], expected)

    def fails(*_: Any, **__: Any) -> None:
        raise RuntimeError("broken")

    with monkeypatch.context() as patched:
        patched.setattr(warm._rest._runtime, "predict", fails)  # type: ignore[attr-defined]
        with pytest.raises(RuntimeError, match="broken"):
            warm.predict_action(later, fresh)
    warm.predict_action(*drawn(0, streams=1))
    report = warm.last_report
    assert report is not None
    assert report.plan.shape[1:2] == (STEPS,), "a new episode, of any number of streams"


def test_nobody_prepares_a_frame_during_a_call(warm: CompiledPolicy) -> None:
    warm.predict_action(*drawn(0))
    frame = {"obs": drawn(1)[0]["obs"][:, 0]}
    assert warm.prepare_frame(frame).computed == 0, "no piece of this policy depends on one frame alone"
    with warm._turn(), pytest.raises(TtscompileError, match="in the middle of a call"):
        warm.prepare_frame(frame)
    with warm._turn(), pytest.raises(TtscompileError, match="in the middle of a call"):
        warm.forget_frames()


def test_what_cannot_go_together_is_refused(loops: tuple[Path, Path], warm: CompiledPolicy, tmp_path: Path) -> None:
    whole, rest = loops
    obs, noise = drawn(0)
    warm.predict_action(obs, noise)
    with pytest.raises(ObservationError, match="keep to the chunk of the call before already"):
        warm.predict_action(obs, noise, prefix=np.zeros((2, 1, 2), np.float32))
    with pytest.raises(ObservationError, match=r"holds the last 3 of 8 steps.*ttscompile.load\(WHOLE, warm=THIS\)"):
        ttscompile.load(rest).predict_action(obs)
    with pytest.raises(ArtifactError, match=r"expected the last steps of a loop; found a whole one of 8 steps"):
        ttscompile.load(whole, warm=whole)
    with pytest.raises(ArtifactError, match=r"expected a whole loop; found the last 3 of 8 steps of ddpm"):
        ttscompile.load(rest, warm=rest)
    with pytest.raises(ExecutorError, match=r"loaded with warm=.*Load it without"):
        ttscompile.AsyncExecutor(warm, 10)
    recording = tmp_path / "calls.npz"
    np.savez(recording, obs=np.arange(320, dtype=np.float32).reshape(8, 2, 20), episode_ends=[4, 8])
    with pytest.raises(CalibrationError, match=r"last 3 of 8 steps.*Calibrate the artifact of the whole loop"):
        ttscompile.calibrate(rest, [recording], 0.5, "interval", progress=False)


def test_the_rest_of_another_loop_is_refused(
    one_layer_checkpoint: Path, loops: tuple[Path, Path], tmp_path: Path
) -> None:
    ttscompile.convert(one_layer_checkpoint, tmp_path / "other", sampler="ddim", steps=STEPS, last_steps=LAST)
    with pytest.raises(ArtifactError, match=r"the rest of .*, of 8 steps of ddpm; found the last 3.*another sampler\."):
        ttscompile.load(loops[0], warm=tmp_path / "other")
    shorter = {"sampler": "ddpm", "steps": STEPS, "last_steps": LAST, "prediction_horizon": 12}
    ttscompile.convert(one_layer_checkpoint, tmp_path / "shorter", **shorter)
    with pytest.raises(ArtifactError, match=r"found the last 3 of 8 steps of ddpm, with another sample, left_out\."):
        ttscompile.load(loops[0], warm=tmp_path / "shorter")


def test_an_artifact_of_the_rest_is_one_like_any_other(loops: tuple[Path, Path], tmp_path: Path) -> None:
    rest, page = str(loops[1]), str(tmp_path / "report.html")
    assert ttscompile.verify(rest).passed
    for words in (["inspect", rest], ["report", rest, "-o", page, "--runs", "1"], ["doctor", rest]):
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, result.output
        told = page if words[0] == "report" else None
        shown = " ".join((Path(told).read_text() if told else result.output).split())
        assert "last 3" in shown, words
