"""The object that users hold: what it gives, what it checks, what it remembers."""

import gc
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Noise, Source
from ttscompile.artifact import Artifact
from ttscompile.core.lattice import dense_plan, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.core.spec import Affine
from ttscompile.errors import IllegalPlanError, ObservationError, TtscompileError
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.load import load
from ttscompile.runtimes.policy import CompiledPolicy

from .agreement import call_terms
from .conftest import MakeArtifact
from .toys import some_noise, toy_program

R = Source.ROLLOUT
OBS = np.array([[0.3, -1.2], [0.7, 0.1]], np.float32)


@pytest.fixture(params=["onnxruntime", "torch", "reference"])
def policy(request: pytest.FixtureRequest, toy_artifact: Artifact) -> CompiledPolicy:
    return load(toy_artifact.path, runtime=request.param, seed=0)


@pytest.fixture
def quick(toy_artifact: Artifact) -> CompiledPolicy:
    return load(toy_artifact.path, seed=0)


@pytest.mark.slow
def test_actions_are_normalised_in_and_out_and_cut(policy: CompiledPolicy, toy_artifact: Artifact) -> None:
    out = policy.predict_action({"obs": OBS}, noise=some_noise(), plan="dense")
    runtime = open_runtime(toy_artifact)
    normalized = OBS * np.array([2, 0.5], np.float32) + np.array([0.1, -0.2], np.float32)
    sample, _ = runtime.predict({"obs": normalized}, some_noise(), Plan(cells=dense_plan(5, 5)))
    expected = (sample - np.array([1, -1])) / np.array([0.5, 4])
    assert set(out) == {"action", "action_pred"}
    assert_equal_but_for_rounding(out["action_pred"], expected, call_terms(toy_artifact))
    assert np.array_equal(out["action"], out["action_pred"][:, 1:3])
    assert out["action"].dtype == np.float32
    assert out["action"].flags.owndata


@pytest.mark.slow
def test_info_is_the_artifacts(quick: CompiledPolicy, toy_artifact: Artifact) -> None:
    info = quick.info
    assert (info.K, info.sample, info.stochastic, info.dense_flops) == (5, (3, 2), True, 1000)
    assert [block.kind for block in info.blocks][:2] == ["self_attention", "feed_forward"]
    assert {block.shape for block in info.blocks} == {(3, 4)}
    assert all(block.flops == 2 * 3 * 4 * 4 for block in info.blocks)
    assert info.observation["obs"].shape == (2,)
    assert (info.action.action_dim, info.action.start, info.action.stop) == (2, 1, 3)
    assert info.identity == toy_artifact.manifest.identity
    assert (info.plans, info.default_plan) == (("dense",), "dense")


def test_the_default_plan_is_dense_until_calibration(quick: CompiledPolicy) -> None:
    assert quick.last_report is None
    quick.predict_action({"obs": OBS})
    report = quick.last_report
    assert report is not None
    assert (report.plan_name, report.computed, report.legalised) == ("dense", (25, 25), (0, 0))
    with pytest.raises(AttributeError):
        quick.last_report = None


def test_plans_of_the_artifact_by_name(own_artifact: Artifact) -> None:
    mixed = uniform_plan(5, 5, 2)
    mixed[1] = R
    store_schedules(own_artifact.path, dict(own_artifact.pruner), {"mixed": mixed}, "tts", {"learned": ["schedule"]})
    for runtime in ("onnxruntime", "torch", "reference"):
        policy = load(own_artifact.path, runtime)
        assert set(policy.info.plans) == {"dense", "mixed", "tts"}
        assert policy.info.default_plan == "tts"
        names = []
        for plan in ("mixed", "mixed", None, "tts", "dense"):
            policy.predict_action({"obs": OBS}, plan=plan)
            report = policy.last_report
            assert report is not None
            names.append((report.plan_name, report.timings.pruner > 0))
            if plan == "mixed":  # its rollout reads are repaired: these cells are computed in steps 0 and 2 alone
                assert report.legalised == (5, 5)
                assert (report.plan[:, 1] == Source.TIMESTEP).all()
        assert names == [("mixed", False), ("mixed", False), ("tts", True), ("tts", True), ("dense", False)]
        with pytest.raises(IllegalPlanError, match=r"no plan 'uniform'; it has \['dense', .*'mixed'"):
            policy.predict_action({"obs": OBS}, plan="uniform")


def test_a_matrix_is_executed_as_it_is_or_refused(policy: CompiledPolicy) -> None:
    rollout = np.full((5, 5), R)
    rollout[0] = Source.COMPUTE
    with pytest.raises(IllegalPlanError, match="ROLLOUT residual was never computed"):
        policy.predict_action({"obs": OBS}, plan=rollout)
    policy.predict_action({"obs": OBS}, plan=[[Source.COMPUTE] * 5] * 5)
    both = np.stack([rollout, dense_plan(5, 5)])
    policy.predict_action({"obs": OBS}, plan=torch.from_numpy(both))
    report = policy.last_report
    assert report is not None
    assert np.array_equal(report.plan, both)
    assert (report.plan_name, report.computed, report.legalised) == ("given", (5, 25), (0, 0))
    policy.reset()
    with pytest.raises(IllegalPlanError, match="never computed"):
        policy.predict_action({"obs": OBS}, plan=both)


def test_a_refused_call_leaves_no_report_of_the_one_before(policy: CompiledPolicy) -> None:
    policy.predict_action({"obs": OBS}, plan="dense")
    with pytest.raises(ObservationError):
        policy.predict_action({"obs": OBS * np.float32(np.nan)}, plan="dense")
    assert policy.last_report is None


def test_torch_in_gives_torch_out(policy: CompiledPolicy) -> None:
    plain = policy.predict_action({"obs": OBS}, noise=some_noise())
    policy.reset()
    noise = some_noise()
    assert noise.steps is not None
    tensors: Any = Noise(torch.from_numpy(noise.initial), torch.from_numpy(noise.steps))  # type: ignore[arg-type]
    out = policy.predict_action({"obs": torch.from_numpy(OBS).requires_grad_()}, noise=tensors)
    for key, value in out.items():
        assert isinstance(value, torch.Tensor)
        assert value.device == tensors.initial.device
        assert not value.requires_grad
        assert np.array_equal(value.numpy(), plain[key])


def test_a_seed_decides_the_noise(toy_artifact: Artifact) -> None:
    def actions(policy: CompiledPolicy, calls: int = 2) -> np.ndarray:
        return np.stack([policy.predict_action({"obs": OBS})["action"] for _ in range(calls)])

    first, second = load(toy_artifact.path, seed=5), load(toy_artifact.path, seed=5)
    drawn = actions(first)
    assert np.array_equal(drawn, actions(second))
    assert not np.array_equal(drawn[0], drawn[1])
    assert not np.array_equal(actions(load(toy_artifact.path, seed=6)), drawn)
    first.reset()
    assert not np.array_equal(actions(first), drawn)
    first.reset(seed=5)
    assert np.array_equal(actions(first), drawn)
    assert not np.array_equal(actions(load(toy_artifact.path)), actions(load(toy_artifact.path)))


@pytest.mark.parametrize("seed", [-1, 0.5, "0", True])
def test_a_seed_that_is_none_is_refused_before_anything_is_done(toy_artifact: Artifact, seed: Any) -> None:
    with pytest.raises(TtscompileError, match=r"seed must be an integer of at least 0"):
        load(toy_artifact.path, seed=seed)
    policy = load(toy_artifact.path, seed=5)
    policy.predict_action({"obs": OBS})
    with pytest.raises(TtscompileError, match=r"seed must be an integer of at least 0"):
        policy.reset(seed=seed)
    with pytest.raises(ObservationError, match="Call reset"):  # the episode is still under way
        policy.predict_action({"obs": OBS[:1]})


def test_load_takes_a_name_of_a_plan_and_no_matrix(toy_artifact: Artifact) -> None:
    with pytest.raises(IllegalPlanError, match=r"name of one, \['dense'.*found a ndarray.*predict_action"):
        load(toy_artifact.path, plan=np.zeros((5, 5), np.int8))  # type: ignore[arg-type]


def with_value(value: float) -> np.ndarray:
    obs = OBS.copy()
    obs[1, 0] = value
    return obs


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        ({}, r"expected the observation keys \['obs'\]; found \[\] \(missing: \['obs'\], unexpected: \[\]\)"),
        ({"obs": OBS, "image": OBS}, r"unexpected: \['image'\]"),
        (OBS, r"a ndarray; expected a dictionary with the keys \['obs'\]"),
        ({"obs": OBS[0]}, r"'obs' has the wrong shape: expected float32 \[B, 2\]; found float32 \[2\].*obs\[None\]"),
        ({"obs": OBS[:, :1]}, r"wrong shape: expected float32 \[B, 2\]; found float32 \[2, 1\]"),
        ({"obs": OBS[:, :0]}, r"wrong shape: .*found float32 \[2, 0\]"),
        ({"obs": OBS[:0]}, r"wrong shape: .*found float32 \[0, 2\]"),
        ({"obs": torch.from_numpy(OBS).double()}, "wrong dtype: .*found float64"),
        (
            {"obs": torch.from_numpy(OBS).bfloat16()},
            r"torch.bfloat16, which numpy does not have.*\.to\(torch.float32\)",
        ),
        ({"obs": OBS.tolist()}, r"a list; expected a numpy array or a torch tensor.*np.asarray"),
        ({"obs": with_value(np.nan)}, r"'obs' must be finite; found nan at index \(1, 0\), 1 such values in all"),
        ({"obs": with_value(-np.inf)}, r"found -inf at index \(1, 0\)"),
    ],
)
def test_an_observation_that_does_not_fit_is_refused(quick: CompiledPolicy, obs: Any, message: str) -> None:
    quick.predict_action({"obs": OBS})
    with pytest.raises(ObservationError, match=message):
        quick.predict_action(obs)
    rollout = dense_plan(5, 5)
    rollout[1:] = R
    quick.predict_action({"obs": OBS}, plan=rollout)  # the episode goes on


def wrong_noise() -> list[tuple[Any, str]]:
    noise = some_noise()
    assert noise.steps is not None
    initial, steps = noise.initial, noise.steps
    broken = steps.copy()
    broken[4, 1, 2, 1] = np.nan
    return [
        (
            Noise(initial[:1], steps),
            r"noise.initial must be float32 \[B, T, D\] = \[2, 3, 2\]; found float32 \[1, 3, 2\]",
        ),
        (Noise(initial, broken), r"noise.steps must be finite; found nan at index \(4, 1, 2, 1\)"),
        (Noise(initial * np.inf, steps), "noise.initial must be finite"),
        (initial, "a ndarray; expected ttscompile.Noise"),
    ]


@pytest.mark.parametrize("case", range(4))
def test_noise_that_does_not_fit_is_refused(quick: CompiledPolicy, case: int) -> None:
    noise, message = wrong_noise()[case]
    with pytest.raises(ObservationError, match=message):
        quick.predict_action({"obs": OBS}, noise=noise)


def test_a_deterministic_sampler_needs_no_noise_of_steps(make_artifact: MakeArtifact) -> None:
    policy = load(make_artifact(toy_program(noise=0.0, pruner=False)).path)
    assert not policy.info.stochastic
    initial, steps = some_noise().initial, some_noise().steps
    out = [policy.predict_action({"obs": OBS}, noise=Noise(initial, draws))["action"] for draws in (None, steps)]
    assert np.array_equal(*out)
    assert policy.predict_action({"obs": OBS})["action"].shape == (2, 2, 2)


def test_observations_that_disagree_about_the_streams_are_refused() -> None:
    from ttscompile import ObservationSpec
    from ttscompile.runtimes.arrays import check_observation

    specs = {"a": ObservationSpec((2,)), "b": ObservationSpec((1, 2), dtype="int64")}
    fits: dict[str, np.ndarray] = {"a": OBS, "b": np.zeros((2, 1, 2), np.int64)}
    assert list(check_observation(fits, specs)) == ["a", "b"]
    with pytest.raises(ObservationError, match=r"\{'a': 1, 'b': 2\}"):
        check_observation(fits | {"a": OBS[:1]}, specs)


def test_a_second_caller_gets_an_error(quick: CompiledPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    inside, leave = threading.Event(), threading.Event()
    normalize: Callable[..., Any] = Affine.normalize

    def slow(self: Affine, x: np.ndarray) -> np.ndarray:
        inside.set()
        assert leave.wait(30)
        return normalize(self, x)

    monkeypatch.setattr(Affine, "normalize", slow)
    results: list[Any] = []
    first = threading.Thread(target=lambda: results.append(quick.predict_action({"obs": OBS})))
    first.start()
    assert inside.wait(30)
    for second in (quick.reset, lambda: quick.predict_action({"obs": OBS})):
        with pytest.raises(TtscompileError, match="in the middle of a call on another thread"):
            second()
    leave.set()
    first.join(30)
    assert results[0]["action"].shape == (2, 2, 2)
    quick.reset()


@pytest.fixture
def without_garbage() -> Iterator[None]:
    """No collection: a library's callback of it, in which an interrupt is lost, may be between any two lines."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("without_garbage")
def test_an_interrupt_at_any_line_of_a_call_comes_through_and_the_next_call_is_made(quick: CompiledPolicy) -> None:
    """Ctrl-C arrives between two lines of Python: of ours, and of what numpy calls, which may swallow it."""
    noise, own = some_noise(), sys.gettrace()

    def call(lines: int) -> int:
        """A call that is interrupted after so many lines; how many it had."""
        count = 0

        def trace(*event: Any) -> Any:
            nonlocal count
            count += event[1] == "line"
            if count == lines:
                sys.settrace(own)
                raise KeyboardInterrupt
            return trace

        sys.settrace(trace)
        try:
            quick.predict_action({"obs": OBS}, noise=noise)
        finally:
            sys.settrace(own)
        return count

    quick.reset()
    expected = quick.predict_action({"obs": OBS}, noise=noise)["action"]
    total = call(-1)
    assert total > 200
    for lines in (*range(1, 40), *range(40, total - 40, 11), *range(total - 40, total)):
        with pytest.raises(KeyboardInterrupt):
            call(lines)
        quick.reset()
    np.testing.assert_array_equal(quick.predict_action({"obs": OBS}, noise=noise)["action"], expected)


def test_a_path_without_an_artifact(tmp_path: Path) -> None:
    with pytest.raises(TtscompileError, match=r"manifest\.json"):
        load(tmp_path)
