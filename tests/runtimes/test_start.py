"""Plans whose loop begins with the chunk of the call before, against the last steps of that loop on their own."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.commands import as_json, done
from tests.once import Once
from tests.plans import base_plan
from ttscompile import Noise, Plan
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import update_plans
from ttscompile.core.correction import groups_of, no_correction
from ttscompile.core.lattice import dense_plan, uniform_plan
from ttscompile.core.start import rest_of
from ttscompile.errors import ArtifactError, IllegalPlanError, ObservationError, TtscompileError
from ttscompile.report.timing import measure_plans, timing_remarks
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.reference.model import ReferenceModel, noise_tensors

pytestmark = pytest.mark.slow

STEPS, LAST, EXECUTED = 8, 3, 8
SHAPE = (2, 16, 2)
WARM = "warm"


def add_start(path: Path, last: int = LAST, cells: np.ndarray | None = None, **fields: Any) -> None:
    """Give an artifact a plan ``warm`` of the last steps of its loop."""
    base = base_plan(path)
    cells = dense_plan(last, len(load_artifact(path).manifest.blocks)) if cells is None else cells
    loop = f"{base.loop}-last-{last}"
    warm = Plan(loop, cells, otherwise=base, **fields)
    own = {name: plan for name, plan in load_artifact(path).plans.items() if plan.otherwise is None}
    base = own["full"]
    update_plans(
        path, {**own, WARM: replace(warm, otherwise=base)}, WARM, {}, starts={loop: StartRecord(base.loop, last)}
    )


@pytest.fixture(scope="module")
def whole(one_layer_checkpoint: Path, once: Once) -> Path:
    """Of a sampler that draws noise."""

    def convert(path: Path) -> None:
        ttscompile.convert(one_layer_checkpoint, path, sampler="ddpm", steps=STEPS)
        add_start(path)

    return once.folder("start", convert)


@pytest.fixture
def warm(whole: Path) -> CompiledPolicy:
    return ttscompile.load(whole, seed=0)


def drawn(call: int, streams: int = 2) -> tuple[dict[str, Any], Noise]:
    rng = np.random.default_rng(call)
    obs = rng.uniform(100, 400, (streams, 2, 20)).astype(np.float32)
    shape = (streams, *SHAPE[1:])
    return {"obs": obs}, Noise(
        rng.standard_normal(shape, dtype=np.float32), rng.standard_normal((STEPS, *shape), dtype=np.float32)
    )


def continued(policy: CompiledPolicy, before: Any, noise: Noise, executed: int = EXECUTED) -> Noise:
    """What the last steps are given after actions ``before``."""
    loop = policy.plans[WARM].otherwise
    assert loop is not None
    start = rest_of(policy._artifact.manifest.sampler_of(loop.loop), LAST)[1]
    assert noise.steps is not None
    normalizer = policy.info.action.normalizer
    assert normalizer is not None
    actions = np.concatenate([before[:, executed:], np.repeat(before[:, -1:], executed, 1)], 1)
    initial = start.action * normalizer.normalize(actions) + start.noise * noise.initial
    return Noise(initial.astype(np.float32), noise.steps[STEPS - LAST :])


def last_steps(policy: CompiledPolicy, obs: dict[str, Any], noise: Noise, plan: Plan) -> np.ndarray:
    """The reference's loop over the last steps alone; the actions."""
    view = view_of(policy._artifact, plan)
    spec, model = view.manifest.spec, ReferenceModel.from_view(view)
    with torch.no_grad():
        given = {key: torch.from_numpy(spec.observations[key].normalized(value)) for key, value in obs.items()}
        assert plan.cells is not None
        made = model.denoise(model.prologue(given), *noise_tensors(noise, True), plan.cells, correction=plan.correction)
    return np.asarray(spec.chunk.unnormalized(made.sample.numpy()))


@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_calls_after_the_first_are_the_last_steps_of_the_loop(whole: Path, runtime: str) -> None:
    both, cold = ttscompile.load(whole, runtime, seed=0), ttscompile.load(whole, runtime, seed=0, plan="full")
    for _ in range(2):  # an episode, and one more
        both.reset()
        obs, noise = drawn(0)
        made = both.predict_action(obs, noise)["action_pred"]
        np.testing.assert_allclose(made, cold.predict_action(obs, noise)["action_pred"], atol=1e-3)
        assert both.last_report is not None
        assert (both.last_report.plan_name, both.last_report.loop) == ("full", "ddpm-8")
        for call in (1, 2):
            obs, noise = drawn(call)
            expected = last_steps(both, obs, continued(cold, made, noise), both.plans[WARM])
            made = both.predict_action(obs, noise)["action_pred"]
            np.testing.assert_allclose(made, expected, atol=0.01)  # px, of 512: the normaliser there and back
            report = both.last_report
            assert report is not None
            assert (report.plan.shape[1], report.plan_name, report.loop) == (LAST, WARM, "ddpm-8-last-3")


def test_a_plan_that_is_sparse_and_corrected_begins_so_too(whole: Path, tmp_path: Path) -> None:
    """What two arguments of load could not have together is two fields of a plan."""
    shutil.copytree(whole, tmp_path / "own")
    blocks, steps = len(load_artifact(whole).manifest.blocks), uniform_plan(LAST, 3, 2)
    bias = np.random.default_rng(0).standard_normal((LAST, 2, 1, 16)).astype(np.float32)
    correction = replace(no_correction(LAST, SHAPE[1:]), bias=bias)
    add_start(tmp_path / "own", cells=steps[:, :1].repeat(blocks, 1), correction=correction)
    policies = [ttscompile.load(tmp_path / "own", name, seed=0) for name in ("onnxruntime", "torch", "reference")]
    made = [policy.predict_action(*drawn(0))["action_pred"] for policy in policies]
    obs, noise = drawn(1)
    expected = last_steps(policies[0], obs, continued(policies[0], made[0], noise), policies[0].plans[WARM])
    for policy in policies:
        np.testing.assert_allclose(policy.predict_action(obs, noise)["action_pred"], expected, atol=0.01)
        assert policy.last_report is not None
        assert policy.last_report.computed == (2 * blocks,) * 2


def test_it_says_what_it_is(warm: CompiledPolicy, whole: Path) -> None:
    cold = ttscompile.load(whole, plan="full").info
    assert (warm.info.K, cold.K) == (LAST, STEPS)
    assert (warm.info.follows, cold.follows) == (True, False)
    assert warm.info.default_plan == WARM


def test_a_timing_says_that_its_calls_begin_with_a_chunk(warm: CompiledPolicy, whole: Path) -> None:
    measured = measure_plans(warm, load_artifact(whole).manifest.spec, ("dense", "full", WARM, f"{WARM}@fp32"), 1)
    assert [one.otherwise for one in measured] == [None, None, "full", "full"]
    assert "'warm' was timed with the chunk of the call before; the first call of" in timing_remarks(measured)
    assert "with the chunk" not in timing_remarks(measured[:2])


def test_predict_says_why_its_call_is_of_another_plan(whole: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "obs.npz", **drawn(0, 1)[0])
    for words, note in (
        ((), "plan 'warm' begins with the chunk of the call before; a first call has none, and computes plan 'full'"),
        (("--plan", "dense"), None),
        (("--plan", "full"), None),
    ):
        told = as_json("predict", whole, "--observation", tmp_path / "obs.npz", *words)
        assert told["plan"] == (words[-1] if words else "full")
        assert told["notes"] == [one for one in (note,) if one is not None]


def test_a_page_of_an_episode_leaves_the_first_call_out(whole: Path, tmp_path: Path) -> None:
    """Which computes ``full``: it has other steps."""
    obs = np.concatenate([drawn(call, 1)[0]["obs"] for call in range(4)])
    np.savez(tmp_path / "calls.npz", obs=obs, episode_ends=np.array([4]))
    done("inspect", whole, "-o", tmp_path / "page.html", "-t", tmp_path / "calls.npz")
    page = (tmp_path / "page.html").read_text()
    assert "3 consecutive calls of calls.npz[0] (without its first call) with the default plan" in page


def test_the_weights_are_there_once(warm: CompiledPolicy) -> None:
    sessions = [one.backend.sessions for one in warm._runtime._opened.values()]  # type: ignore[attr-defined]
    assert len(sessions) == 2
    assert all(one is sessions[0][name] for name, one in sessions[1].items())


def test_the_arithmetic_of_the_last_steps_is_counted(warm: CompiledPolicy, whole: Path) -> None:
    artifact = load_artifact(whole)
    all_steps, own = (view_of(artifact, name).manifest.flops for name in ("full", WARM))
    warm.predict_action(*drawn(0))
    warm.predict_action(*drawn(1))
    report = warm.last_report
    assert report is not None
    assert report.flops == (own.prologue + LAST * (own.stem + own.tail + sum(own.blocks)),) * 2
    assert own.prologue < all_steps.prologue
    assert own.dense == all_steps.dense == artifact.manifest.flops.dense, "of the original, whatever the loop"


def test_an_update_in_fewer_groups_than_the_last_steps_would_have(
    one_layer_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a long loop corrections share a matrix between dimensions, and its graph wants that of its last steps, too."""
    monkeypatch.setattr("ttscompile.core.correction.LARGEST", 7 * 2 * 6 * 16 * 16)
    ttscompile.convert(one_layer_checkpoint, tmp_path / "whole", sampler="ddim", steps=STEPS)
    add_start(tmp_path / "whole")
    warm = ttscompile.load(tmp_path / "whole", seed=0)
    assert (groups_of(STEPS, (16, 2)), groups_of(LAST, (16, 2))) == (1, 2)
    for call in range(2):
        obs, noise = drawn(call)
        made = warm.predict_action(obs, Noise(noise.initial))["action"]
    assert np.isfinite(made).all()


def test_actions_one_by_one_begin_chunks_in_turn(warm: CompiledPolicy, whole: Path) -> None:
    again = ttscompile.load(whole, seed=0)
    rng = np.random.default_rng(5)
    frames = rng.uniform(100, 400, (EXECUTED + 1, 2, 20)).astype(np.float32)
    one_by_one = [warm.select_action({"obs": frame}) for frame in frames]
    first = again.predict_action({"obs": np.stack([frames[0]] * 2, 1)})["action"]
    second = again.predict_action({"obs": np.stack([frames[-2], frames[-1]], 1)})["action"]
    np.testing.assert_array_equal(np.stack(one_by_one, 1), np.concatenate([first, second[:, :1]], 1))


def test_a_call_that_is_early_moves_the_chunk_by_less_and_one_that_is_late_begins_with_noise(
    warm: CompiledPolicy,
) -> None:
    made = warm.predict_action(*drawn(0))["action_pred"]
    warm.follow(5)
    obs, noise = drawn(1)
    expected = last_steps(warm, obs, continued(warm, made, noise, executed=5), warm.plans[WARM])
    np.testing.assert_allclose(warm.predict_action(obs, noise)["action_pred"], expected, atol=0.01)
    warm.follow(EXECUTED + 1)
    warm.predict_action(*drawn(2))
    assert warm.last_report is not None
    assert warm.last_report.plan_name == "full"
    with pytest.raises(TtscompileError, match="executed"):
        warm.follow(-1)


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
    with pytest.raises(IllegalPlanError, match="no plan 'fast'"):
        warm.predict_action(later, fresh, plan="fast")
    with pytest.raises(ObservationError, match=r"noise.initial must be float32"):
        warm.predict_action(later, Noise(fresh.initial[:, :3], fresh.steps))
    with pytest.raises(ObservationError, match=r"obs"):
        warm.predict_action({"obs": later["obs"] * np.float32(np.nan)}, fresh)
    np.testing.assert_array_equal(warm.predict_action(later, fresh)["action"], expected)

    def fails(*_: Any, **__: Any) -> None:
        raise RuntimeError("broken")

    with monkeypatch.context() as patched:
        patched.setattr(warm._runtime.backend, "other_steps", fails)
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


def test_what_cannot_go_together_is_refused(whole: Path, warm: CompiledPolicy, tmp_path: Path) -> None:
    obs, noise = drawn(0)
    warm.predict_action(obs, noise)
    told = r"begins with the chunk of the call before, and so keeps to it already\. Call it without one\.$"
    with pytest.raises(ObservationError, match=told):
        warm.predict_action(obs, noise, prefix=np.zeros((2, 1, 2), np.float32))
    with pytest.raises(IllegalPlanError, match="expected the plan of a call that has no chunk to begin with"):
        warm.predict_action(obs, noise, plan=replace(warm.plans[WARM], otherwise=None))
    # One that begins with a chunk itself would begin with noise in the middle of the loop.
    again = replace(warm.plans[WARM], otherwise=warm.plans[WARM])
    with pytest.raises(IllegalPlanError, match="as otherwise, which is in loop 'ddpm-8'"):
        warm.predict_action(obs, noise, plan=again)
    with pytest.raises(IllegalPlanError, match="expected none as otherwise"):
        warm.predict_action(obs, noise, plan=replace(warm.plans["full"], otherwise=warm.plans["dense"]))
    shutil.copytree(whole, tmp_path / "own")
    with pytest.raises(ArtifactError, match="fewer steps than the 8 of loop 'ddpm-8'"):
        add_start(tmp_path / "own", STEPS)
