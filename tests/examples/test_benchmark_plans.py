"""The plans, the floor and the rounds of the benchmark; no time is asserted."""

from dataclasses import replace
from pathlib import Path

import floor
import numpy as np
import pytest
import rounds
import torch
from networks import plan_at, plan_name, random_network, sampler_of
from torch import nn

import ttscompile
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import Source
from ttscompile.artifact import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.report.timing import Contestant, Measurement
from ttscompile.runtimes.onnxruntime.sessions import Bound, Sessions
from ttscompile.runtimes.onnxruntime.workspace import Workspace
from ttscompile.runtimes.random_calls import random_calls

NO_NOISE = ttscompile.Noise(np.zeros((1, 4, 2), np.float32))
"""For contestants that make their own."""


@pytest.mark.parametrize("steps", [8, 16, 100])
@pytest.mark.parametrize("sparsity", [0.0, 0.8, 0.9, 0.95, 0.98])
def test_a_plan_has_its_share_of_reused_cells(steps: int, sparsity: float) -> None:
    plan = plan_at(steps, 24, sparsity)
    assert (plan is None) == ((1 - sparsity) * steps < 1 - 1e-9)
    if plan is None:
        return
    assert plan.shape == (steps, 24)
    assert np.count_nonzero(plan == Source.COMPUTE) == round((1 - sparsity) * steps * 24)
    assert (plan[0] == Source.COMPUTE).all()
    assert set(np.unique(plan)) <= {Source.COMPUTE, Source.TIMESTEP}


@pytest.mark.slow
def test_a_sampler_may_have_more_steps_than_the_training() -> None:
    table = sampler_of("ddpm", 120)
    assert table.steps == len(set(table.timesteps.tolist())) == 120
    assert sampler_of("ddim", 8).steps == 8


@pytest.fixture(scope="module")
def tiny(tiny_artifact: Path) -> tuple[Path, dict[float, np.ndarray]]:
    found = {s: load_artifact(tiny_artifact).plans[plan_name(s)].cells for s in (0.0, 0.5)}
    return tiny_artifact, {s: cells for s, cells in found.items() if cells is not None}


@pytest.mark.slow
def test_an_artifact_has_the_plans_that_there_can_be(tiny: tuple[Path, dict[float, np.ndarray]]) -> None:
    directory, plans = tiny
    artifact = load_artifact(directory)
    assert set(artifact.plans) == {"dense", "reuse-0%", "reuse-50%"}  # 98 % were asked for, too
    assert artifact.manifest.default_plan == "reuse-50%"
    np.testing.assert_array_equal(plans[0.5], plan_at(8, 3, 0.5))
    assert (plans[0.0] == Source.COMPUTE).all()


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_the_floor_runs_every_block_as_often_as_it_says(
    tiny: tuple[Path, dict[float, np.ndarray]], threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory, plans = tiny
    ran = []
    monkeypatch.setattr(Bound, "run", lambda self: ran.append(self))
    contestant = floor.blocks_contestant(directory, threads)
    contestant.call({}, NO_NOISE)
    assert len(ran) == 3 * floor.SEQUENCES
    assert ran[:3] == ran[3:6]
    assert len(set(map(id, ran))) == 3
    artifact = load_artifact(directory)
    flops = artifact.manifest.flops.blocks
    assert contestant.dense_flops == floor.SEQUENCES * sum(flops)
    # At 5 sequences in 20 ms, the eight steps of a dense call take 32 ms, and half of its cells half of that.
    blocks = Measurement("", "", (20.0,), flops=contestant.dense_flops)
    assert floor.floor_ms(plans[0.0], artifact, blocks) == pytest.approx(32.0)
    assert floor.floor_ms(plans[0.5], artifact, blocks) == pytest.approx(16.0)


@pytest.mark.slow
def test_the_floors_blocks_compute_numbers(tiny: tuple[Path, dict[float, np.ndarray]]) -> None:
    view = view_of(load_artifact(tiny[0]))
    sessions = Sessions(1).of(view)
    for b in range(3):
        bound = floor._bind(view, sessions[f"block_{b:02d}"], b)
        bound.run()
        assert np.isfinite(bound._arrays[-1]).all()
        assert bound._arrays[-1].std() > 0


@pytest.mark.slow
def test_tails_take_every_step(tiny: tuple[Path, dict[float, np.ndarray]], monkeypatch: pytest.MonkeyPatch) -> None:
    directory, plans = tiny
    steps: list[int] = []
    advance, idle = Workspace.advance, Workspace.run_idle

    def counted(self: Workspace, k: int) -> None:
        steps.append(k)
        advance(self, k)

    def run_idle(self: Workspace, first: int, stop: int) -> None:
        steps.extend(range(first, stop))
        idle(self, first, stop)

    monkeypatch.setattr(Workspace, "advance", counted)
    monkeypatch.setattr(Workspace, "run_idle", run_idle)
    for plan in plans.values():
        contestant = floor.tails_contestant(directory, 1, plan)
        contestant.call({}, NO_NOISE)
        assert steps == list(range(8))
        steps.clear()


def test_passes_are_pooled_and_every_group_has_its_threads() -> None:
    spec = random_network(16, "ddim", 8, layers=1).spec
    seen = []

    def contestant(label: str) -> Contestant:
        return Contestant(label, "", lambda *_: seen.append((label, torch.get_num_threads())), lambda: None, spec, 1.0)

    before = torch.get_num_threads()
    groups = {1: [contestant("a"), contestant("b")], 2: [contestant("a")]}
    ticks = []
    measured = rounds.measure_in_passes(groups, rounds.Effort(2, 3), lambda: ticks.append(1))
    assert torch.get_num_threads() == before
    assert [[len(m.times_ms) for m in measured[threads]] for threads in (1, 2)] == [[6, 6], [6]]
    assert measured[1][0].median_ms == pytest.approx(np.median(measured[1][0].times_ms))
    assert {one for one in seen if one[0] == "b"} == {("b", 1)}
    assert len([one for one in seen if one == ("a", 2)]) == len(ticks) / 2 == (3 + 2) + (1 + 2) + (1 + 2)
    assert len(ticks) == rounds.rounds_of(groups, rounds.Effort(2, 3))


@pytest.mark.slow
def test_eager_and_compiled_agree(tiny: tuple[Path, dict[float, np.ndarray]]) -> None:
    network = random_network(16, "ddim", 8, layers=1)
    ((obs, noise),) = random_calls(network.spec, 1, seed=0)
    with Counted() as counted:
        eager = rounds.eager_contestant(network, 1.0).call(obs, noise)
    found = ttscompile.load(tiny[0]).predict_action(obs, noise=noise, plan="dense")["action_pred"]
    assert_equal_but_for_rounding(np.asarray(eager), found, counted.terms, counted.angle)


def test_without_torch_compile_the_reason_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    class Refusing(nn.Module):
        def forward(self, **_: object) -> None:
            raise RuntimeError("no C++\n\ncompiler\nand much more")

    monkeypatch.setattr(torch, "compile", lambda module, **_: Refusing())
    with pytest.raises(RuntimeUnavailableError, match=r"RuntimeError: no C\+\+ compiler \(inductor needs"):
        rounds.torch_compile_contestant(random_network(16, "ddim", 8, layers=1), 1.0, 1)


class Small(nn.Module):
    """Takes what the benchmark's networks take; inductor has little to compile."""

    def __init__(self) -> None:
        super().__init__()
        self.mix = nn.Linear(2, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.mix(sample)) + 0.01 * timestep[:, None, None] * obs.mean((1, 2), keepdim=True)


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_torch_compile_computes_the_same() -> None:
    network = replace(random_network(16, "ddim", 8, layers=1), module=Small().eval())
    ((obs, noise),) = random_calls(network.spec, 1, seed=0)
    try:
        contestant = rounds.torch_compile_contestant(network, 1.0, 1)
    except RuntimeUnavailableError as error:
        pytest.skip(str(error))
    found = contestant.call(obs, noise)
    with Counted() as counted:
        expected = rounds.eager_contestant(network, 1.0).call(obs, noise)
    assert_equal_but_for_rounding(found, expected, counted.terms)
