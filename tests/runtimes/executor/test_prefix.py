"""The seam ``prefix`` with compiled policies: what is committed is what the next chunk begins with."""

import shutil
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diffusers.schedulers.scheduling_ddim import DDIMScheduler

import ttscompile
from tests.once import Once
from tests.rounding import allowed, assert_equal_but_for_rounding
from tests.runtimes import committed
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile import AsyncExecutor, ExecutorSettings
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.artifact.write import update_plans
from ttscompile.core.correction import no_correction
from ttscompile.core.plan import Plan
from ttscompile.core.spec import Relative
from ttscompile.errors import ExecutorError
from ttscompile.runtimes.executor.settings import resolve
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.samplers.table import sampler_table

from .simulation import actions_of

HZ, HORIZON, LATENCY = 10.0, 12, 0.2


@pytest.fixture(scope="module", params=[None, Relative("obs", (1, None))], ids=["absolute", "relative"])
def inpainting(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy with DDIM and eleven actions a chunk, of which a number may be relative to the observation."""
    program = toy_program(pruner=False, horizon=HORIZON)
    table = sampler_table(DDIMScheduler(num_train_timesteps=50, beta_schedule="squaredcos_cap_v2"), steps=5)
    chunk = replace(program.spec.chunk, relative=request.param)
    program = replace(program, spec=replace(program.spec, sampler=table, chunk=chunk))
    return written_artifact(program, tmp_path_factory.mktemp("inpainting") / "artifact").path


class Recorded:
    """A policy that keeps what it was given and what it gave.

    Attributes:
        calls: prefix and predicted actions of each call.
    """

    def __init__(self, policy: CompiledPolicy) -> None:
        self.info, self.reset, self._policy = policy.info, policy.reset, policy
        self.calls: list[tuple[np.ndarray, np.ndarray]] = []

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str, prefix: Any = None) -> dict[str, Any]:
        predicted = self._policy.predict_action(obs_dict, plan=plan, prefix=prefix)
        self.calls.append((prefix[0], predicted["action_pred"][0]))
        return predicted


def drive(
    path: Path, ticks: int, latency: float = LATENCY, numbers: int = 2
) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Actions of a loop at the policy's rate whose calls are said to take so long, and the calls."""
    policy, rng = Recorded(ttscompile.load(path, seed=0)), np.random.default_rng(0)
    settings = ExecutorSettings(seam="prefix", n_obs_steps=1)
    actions = actions_of(policy, settings, HZ, latency, lambda _: rng.standard_normal(numbers), ticks)
    return actions, policy.calls


@pytest.mark.slow
def test_a_compiled_policy_keeps_what_is_committed(inpainting: Path) -> None:
    actions, calls = drive(inpainting, ticks=60)
    assert calls[0][0].shape == (0, 2)  # nothing was scheduled yet
    assert len(calls) > 5
    for prefix, predicted in calls[1:]:
        assert prefix.shape == (3, 2)  # now, and the two ticks that the call may take
        assert_equal_but_for_rounding(predicted[1:4], prefix, terms=6)  # normalised and back
        rounding = 2 * allowed(prefix, terms=6)  # of both channels
        assert np.abs(actions[:, None] - prefix).sum(-1).min(axis=0).max() <= rounding  # all of it was played


@pytest.mark.slow
def test_a_policy_that_was_trained_with_prefixes_goes_on_from_what_is_committed(once: Once) -> None:
    """A policy that was trained with three actions, in a loop whose calls are said to take a tick."""
    path, _ = once.compiled("committed rk4", lambda to: committed.compiled("rk4", to))
    info = ttscompile.load(path).info
    resolved = [resolve(ExecutorSettings(seam=seam), info, HZ) for seam in ("prefix", "blend")]
    assert [each.trained_prefix for each in resolved] == [committed.LONGEST, 0]
    assert [each.feasibility(0.2).committed for each in resolved] == [pytest.approx(0.2), np.inf]
    _, calls = drive(path, ticks=20, latency=0.1, numbers=4)
    assert max(len(prefix) for prefix, _ in calls) == 2  # now, and the tick that the call may take
    for prefix, predicted in calls:
        assert_equal_but_for_rounding(predicted[1 : 1 + len(prefix)], prefix, terms=6)


def test_a_policy_that_cannot_inpaint_is_refused_when_the_executor_is_made(toy_compiled: Path) -> None:
    policy = ttscompile.load(toy_compiled)
    with pytest.raises(
        ExecutorError,
        match=r"inpaints it; plan 'dense' of this one does not: the table of its sampler 'toy' does not give.*='blend'",
    ):
        AsyncExecutor(policy, HZ, ExecutorSettings(seam="prefix"))


def test_each_plan_says_for_itself_whether_it_takes_a_prefix(inpainting: Path, tmp_path: Path) -> None:
    """Of a policy whose plan ``warm`` begins with the chunk of the call before, and so takes none."""
    shutil.copytree(inpainting, tmp_path / "warm")
    plans = dict(ttscompile.load(inpainting).plans)
    base = plans["dense"]
    plans["warm"] = replace(base, loop="last-2", cells=np.zeros((2, 5), np.int8), otherwise=base)
    update_plans(tmp_path / "warm", plans, "warm", {}, starts={"last-2": StartRecord(base.loop, 2)})
    for loaded in ("warm", "dense"):
        policy = ttscompile.load(tmp_path / "warm", plan=loaded)
        assert (policy.prefix_refusal("dense"), policy.prefix_refusal(plans["dense"])) == (None, None)
        assert "begins with the chunk of the call before" in (policy.prefix_refusal("warm") or "")
        assert policy.prefix_refusal() == policy.info.prefix_refusal == policy.prefix_refusal(loaded)
        settings = ExecutorSettings(seam="prefix", n_obs_steps=1, tiers=("dense", "warm"))
        with pytest.raises(ExecutorError, match="plan 'warm' of this one does not: its plan begins with"):
            AsyncExecutor(policy, HZ, settings, latencies={"dense": LATENCY, "warm": LATENCY})
        AsyncExecutor(policy, HZ, replace(settings, tiers=("dense",)), latencies={"dense": LATENCY}).close()


def test_latencies_are_measured_with_a_prefix(inpainting: Path) -> None:
    policy = Recorded(ttscompile.load(inpainting, seed=0))
    settings = ExecutorSettings(seam="prefix", warm_up=1, measured_calls=2, n_obs_steps=1)
    with AsyncExecutor(policy, HZ, settings):
        assert [prefix.shape for prefix, _ in policy.calls] == [(1, 2)] * 3


@pytest.mark.parametrize(("fitted", "told"), [(0, "at most 0 committed"), (2, "at most 2 committed"), (3, None)])
def test_a_correction_that_was_fitted_with_shorter_prefixes_is_told_of(
    inpainting: Path, tmp_path: Path, fitted: int, told: str | None
) -> None:
    artifact = load_artifact(shutil.copytree(inpainting, tmp_path / "artifact"))
    cells, like = artifact.plans["dense"].cells, no_correction(5, artifact.manifest.spec.sample)
    late = replace(like, prefixes=fitted) if fitted else None
    update_plans(artifact.path, {"fast": Plan(cells=cells, correction=replace(like, late=late))}, "fast")
    policy, settings = ttscompile.load(artifact.path, seed=0), ExecutorSettings(seam="prefix", horizon=3)
    expected = nullcontext() if told is None else pytest.warns(UserWarning, match=f"plan 'fast' .* {told} .* up to 3,")
    with expected, AsyncExecutor(policy, HZ, settings, latencies={"fast": LATENCY}):
        pass
    other = replace(settings, seam="replace"), replace(settings, tiers=("dense",))
    for one in other:
        AsyncExecutor(policy, HZ, one, latencies={"fast": LATENCY, "dense": LATENCY}).close()
