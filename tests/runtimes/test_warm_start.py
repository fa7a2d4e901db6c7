"""Calls that begin with the chunk of the call before, against the two loops on their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.once import Once
from ttscompile import Noise
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.rest import with_last_steps
from ttscompile.core.correction import groups_of
from ttscompile.core.rest import rest_of
from ttscompile.errors import (
    ArtifactError,
    ExecutorError,
    IllegalPlanError,
    ObservationError,
    SpecError,
    TtscompileError,
)
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy

STEPS, LAST, EXECUTED = 8, 3, 8
SHAPE = (2, 16, 2)


@pytest.fixture(scope="module")
def whole(one_layer_checkpoint: Path, once: Once) -> Path:
    """Of a sampler that draws noise."""

    def convert(path: Path) -> None:
        ttscompile.convert(one_layer_checkpoint, path, sampler="ddpm", steps=STEPS)

    return once.compiled("warm whole", convert)[0]


@pytest.fixture(params=["onnxruntime", "torch", "reference"])
def policies(request: pytest.FixtureRequest, whole: Path) -> tuple[CompiledPolicy, ...]:
    """Warm calls, the whole loop alone, and the rest alone."""
    warm, cold = (ttscompile.load(whole, request.param, seed=0, warm=warm) for warm in (LAST, None))
    rest, _ = with_last_steps(load_artifact(whole), LAST)
    return warm, cold, open_policy(rest, request.param)


@pytest.fixture
def warm(whole: Path) -> CompiledPolicy:
    return ttscompile.load(whole, seed=0, warm=LAST)


def drawn(call: int, streams: int = 2) -> tuple[dict[str, Any], Noise]:
    rng = np.random.default_rng(call)
    obs = rng.uniform(100, 400, (streams, 2, 20)).astype(np.float32)
    shape = (streams, *SHAPE[1:])
    return {"obs": obs}, Noise(
        rng.standard_normal(shape, dtype=np.float32), rng.standard_normal((STEPS, *shape), dtype=np.float32)
    )


def continued(policy: CompiledPolicy, before: Any, noise: Noise) -> Noise:
    """What the rest is given after actions ``before``."""
    start = rest_of(policy._artifact.manifest.spec.sampler, LAST)[1]
    assert noise.steps is not None
    normalizer = policy.info.action.normalizer
    assert normalizer is not None
    actions = np.concatenate([before[:, EXECUTED:], np.repeat(before[:, -1:], EXECUTED, 1)], 1)
    initial = start.action * normalizer.normalize(actions) + start.noise * noise.initial
    return Noise(initial.astype(np.float32), noise.steps[STEPS - LAST :])


@pytest.mark.slow
def test_calls_after_the_first_are_the_rest_of_the_loop(policies: tuple[CompiledPolicy, ...]) -> None:
    both, cold, rest = policies
    for _ in range(2):  # an episode, and one more
        both.reset()
        obs, noise = drawn(0)
        made = both.predict_action(obs, noise)["action_pred"]
        np.testing.assert_allclose(made, cold.predict_action(obs, noise)["action_pred"], atol=1e-3)
        for call in (1, 2):
            obs, noise = drawn(call)
            expected = rest.predict_action(obs, continued(cold, made, noise))["action_pred"]
            made = both.predict_action(obs, noise)["action_pred"]
            np.testing.assert_allclose(made, expected, atol=0.01)  # px, of 512: the normaliser there and back
            report = both.last_report
            assert report is not None
            assert report.plan.shape[1] == LAST


def test_it_says_what_it_is(warm: CompiledPolicy, whole: Path) -> None:
    cold, shorter = ttscompile.load(whole).info, ttscompile.load(whole, warm=LAST - 1).info
    assert (warm.info.warm_steps, cold.warm_steps, shorter.warm_steps) == (LAST, None, LAST - 1)
    assert len({warm.info.identity, cold.identity, shorter.identity}) == 3
    assert len(warm.info.identity) == len(cold.identity)
    assert warm.info.K == STEPS
    assert ttscompile.load(whole, warm=False).info.warm_steps is None


def test_the_weights_are_there_once(warm: CompiledPolicy) -> None:
    sessions = [policy._runtime.backend.sessions for policy in (warm, warm._rest)]  # type: ignore[attr-defined]
    assert sessions[0] is sessions[1]


def test_the_arithmetic_of_the_rest_is_counted(warm: CompiledPolicy, whole: Path) -> None:
    cold, (rest, _) = load_artifact(whole), with_last_steps(load_artifact(whole), LAST)
    warm.predict_action(*drawn(0))
    warm.predict_action(*drawn(1))
    report, own, all_steps = warm.last_report, rest.manifest.flops, cold.manifest.flops
    assert report is not None
    step = own.stem + own.tail + sum(own.blocks)
    assert report.flops == (own.prologue + LAST * step,) * 2
    assert own.prologue <= all_steps.prologue
    assert own.dense == all_steps.dense * LAST // STEPS


@pytest.mark.slow
def test_an_update_in_fewer_groups_than_the_rest_would_have(
    one_layer_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a long loop corrections share a matrix between dimensions, and its graph wants that of its rest, too."""
    monkeypatch.setattr("ttscompile.core.correction.LARGEST", 7 * 2 * 6 * 16 * 16)
    ttscompile.convert(one_layer_checkpoint, tmp_path / "whole", sampler="ddim", steps=STEPS)
    warm = ttscompile.load(tmp_path / "whole", seed=0, warm=LAST)
    assert (groups_of(STEPS, (16, 2)), groups_of(LAST, (16, 2))) == (1, 2)
    for call in range(2):
        obs, noise = drawn(call)
        made = warm.predict_action(obs, Noise(noise.initial))["action"]
    assert np.isfinite(made).all()


def test_actions_one_by_one_begin_chunks_in_turn(warm: CompiledPolicy, whole: Path) -> None:
    again = ttscompile.load(whole, seed=0, warm=LAST)
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


def test_what_cannot_go_together_is_refused(whole: Path, warm: CompiledPolicy) -> None:
    obs, noise = drawn(0)
    warm.predict_action(obs, noise)
    with pytest.raises(ObservationError, match="keep to the chunk of the call before already"):
        warm.predict_action(obs, noise, prefix=np.zeros((2, 1, 2), np.float32))
    with pytest.raises(ExecutorError, match=r"loaded with warm=.*Load it without"):
        ttscompile.AsyncExecutor(warm, 10)
    with pytest.raises(SpecError, match=r"last_steps is 8; expected fewer than the 8 steps of the loop"):
        ttscompile.load(whole, warm=STEPS)
    with pytest.raises(SpecError, match=r"last_steps.*'rest'"):
        ttscompile.load(whole, warm="rest")  # type: ignore[arg-type]
    with pytest.raises(ArtifactError, match=r"was not settled. Run 'ttscompile warm-start .*warm=3"):
        ttscompile.load(whole, warm=True)
