"""The paper's head and its training: the layer is torch's, gradients are the gates', and runtimes execute it."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from at_its_word import main, train
from click.testing import CliRunner
from decoder_head import BASE, FIXED, DecoderHead, time_tokens
from dropped import DroppedHead
from gate_checks import main as check
from gate_gradients import GateGradients
from head_training import EPOCHS, WARM, Recipe, Training, later, price_of, rate_of
from torch import Tensor, nn

import ttscompile
from tests.calibration import policies
from tests.calibration.tasks import in_windows, make_task
from tests.once import Once
from tests.passes.modules import compiled as compiled_module, run_graph
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import Noise
from ttscompile.artifact.write import write_artifact
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.pruner.straight_through import legal
from ttscompile.calibration.task import Task
from ttscompile.core.lattice import PlanArray, Source
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.program import Program
from ttscompile.lower.program import lower_program
from ttscompile.policies.networks.transformer_for_diffusion import TransformerConfig, TransformerForDiffusion
from ttscompile.runtimes.reference.reuse import Caches
from ttscompile.verification.record_golden import record_original

SMALL = DecoderHead(width=16, inner=24, heads=2)


def torchs(program: Program, feature: Tensor, steps: int) -> Tensor:
    """The same head of torch's own modules: one layer, asked at each step for the memory of that step."""
    given = {name: torch.from_numpy(value) for name, value in program.weights.items() if name.startswith("pruner.")}

    def linear(name: str, value: Tensor) -> Tensor:
        return nn.functional.linear(value, given[f"pruner.{name}.weight"], given[f"pruner.{name}.bias"])

    layer = nn.TransformerDecoderLayer(16, 2, 24, 0.0, batch_first=True, norm_first=True).eval()
    own = {"self_attn.in_proj": "self.in", "self_attn.out_proj": "self.out", "multihead_attn.out_proj": "cross.out"}
    own |= {"linear1": "wide", "linear2": "narrow", **{f"norm{i}": f"norm{i}" for i in (1, 2, 3)}}
    state = dict[str, Tensor]()
    for kind in ("weight", "bias"):
        for name, ours in own.items():
            state[f"{name}_{kind}" if name.endswith("in_proj") else f"{name}.{kind}"] = given[f"pruner.{ours}.{kind}"]
        state[f"multihead_attn.in_proj_{kind}"] = torch.cat([given[f"pruner.cross.{one}.{kind}"] for one in "qkv"])
    layer.load_state_dict(state)
    found = []
    for k in range(steps):
        time = linear("clock", given["pruner.time"][k]).expand(len(feature), 1, -1)
        memory = torch.cat([linear("memory0", feature), time], 1)
        found.append(linear("head", layer(given["pruner.query"].expand(len(feature), -1, -1), memory)))
    return torch.stack(found, 1) + given[BASE] + given["pruner.mask"]


def test_the_head_is_torchs_decoder_layer_at_every_step() -> None:
    program = SMALL(compiled_module("tokens")[1]).program
    assert program.pieces.pruner is not None
    (name,) = program.pieces.features
    type_ = program.pieces.pruner.inputs[name]
    feature = torch.randn(type_.at(3), generator=torch.Generator().manual_seed(0))
    with torch.no_grad(), Counted() as counted:
        (logits,) = run_graph(program, program.pieces.pruner, {name: feature})
        assert logits.shape == (3, 5, 6, 4)
        expected = torchs(program, feature.movedim(type_.batch_axis or 0, 0), 5)
    free = expected.abs() < 1e2
    assert free.any() and (logits[:, 0].argmax(-1) == 0).all()
    assert_equal_but_for_rounding(logits[free], expected[free], counted.terms)


def test_a_width_that_heads_cannot_share_is_refused() -> None:
    with pytest.raises(PassError, match="DecoderHead: a width of 20: expected a multiple of twice the 8 heads"):
        DecoderHead(width=20)(compiled_module("tokens")[1])


@pytest.fixture(scope="session")
def decoder(once: Once) -> Path:
    """The small nonlinear policy with the paper's head."""

    def write(folder: Path) -> None:
        module = policies.Mixer(0).eval()
        program = SMALL(transform(module, policies.spec())).program
        write_artifact(program, lower_program(program), folder / "artifact", golden=record_original(module, program))

    return once.folder("decoder head", write) / "artifact"


@pytest.fixture
def task(decoder: Path, tmp_path: Path) -> Task:
    task = make_task(decoder, policies.record(tmp_path / "calls.npz", episodes=6), calls=2)
    calls = in_windows(task, 8)
    return Task.of(task.runner, calls, 20, 0)


def naive(of: GateGradients, plans: PlanArray, gates: Tensor, numbers: np.ndarray) -> list[Tensor]:
    """The samples of sparse calls, with every cell the sum of four gated residuals; those in caches are detached.

    Where gates have a part of what later cells read, caches are sums of two of them.
    """
    runner, caches = of.runner, Caches({})
    calls, there = runner.select(of.calls, numbers), torch.from_numpy(numbers)

    def blocks(k: int, stream: Tensor) -> Tensor:
        for b, group in enumerate(runner.model.groups):
            own = runner.model.block(b, k, stream, calls.contexts)
            dense = own if of.sparse_stream else of.residual(of.dense(k, there, b, b + 1)[:, 0].float())
            takers = torch.from_numpy(plans[:, k, b] == Source.COMPUTE)[:, None, None]
            computed = torch.where(takers, own, dense)
            if k == 0:
                caches.forward[group] = caches.timestep[b] = own.detach()
                stream = stream + own
                continue
            written = of.residual(of.rows(computed))
            rollout = torch.zeros_like(written)
            for n in range(calls.count):
                before = [m for m in range(n - n % calls.window, n) if plans[m, k, b] == Source.COMPUTE]
                if before:
                    rollout[n] = written[before[-1]]
            candidates = (computed, caches.forward[group], caches.timestep[b], rollout)
            gate = gates[:, k, b, :, None, None]
            stream = stream + sum(gate[:, i] * one for i, one in enumerate(candidates))
            taken = gate[:, 0] if of.through_caches else takers.float()
            caches.forward[group] = taken * written + (1 - taken) * caches.forward[group]
            caches.timestep[b] = taken * written + (1 - taken) * caches.timestep[b]
        return stream

    return list(runner.samples(calls, blocks))


@pytest.mark.parametrize(("through_caches", "sparse_stream"), [(False, False), (True, False), (False, True)])
def test_the_gradient_of_every_gate_is_that_of_a_sum_of_four(
    task: Task, through_caches: bool, sparse_stream: bool
) -> None:
    numbers = np.arange(4, 16)
    of = GateGradients(task.runner, task.calls, through_caches=through_caches, sparse_stream=sparse_stream)
    wished = np.random.default_rng(0).integers(0, 4, (12, 10, 6)).astype(np.int8)
    plans = legal(wished, task.calls.window)
    plans[:, 3] = Source.TIMESTEP  # a step without a computed block
    plans[:, 5] = Source.COMPUTE  # and one in which all are
    plans = legal(plans, task.calls.window)
    assert {int(one) for one in np.unique(plans[:, 1:])} == {0, 1, 2, 3}

    def loss(samples: Sequence[Tensor], calls: Calls) -> Tensor:
        return (samples[-1] - calls.targets).abs().mean() + samples[4].square().mean()

    value, found = of(plans, numbers, loss)
    gates = nn.functional.one_hot(torch.from_numpy(plans.astype(np.int64)), 4).float().requires_grad_()
    expected = loss(naive(of, plans, gates, numbers), task.runner.select(task.calls, numbers))
    (gradient,) = torch.autograd.grad(expected, [gates])
    assert value == pytest.approx(expected.item(), rel=1e-5)
    assert found[:, 0].count_nonzero() == 0 and found[:, 1:].count_nonzero() > 1000
    scale = gradient.abs().amax((1, 2, 3), keepdim=True)
    assert ((found - gradient)[:, 1:].abs() <= 0.02 * scale).all()  # what is not computed is there in bfloat16
    exact = [int(Source.FORWARD), int(Source.TIMESTEP), int(Source.ROLLOUT)]
    assert ((found - gradient)[:, 1:, :, exact].abs() <= 1e-4 * scale).all()


def test_dense_first_calls_are_not_run_and_are_read(task: Task) -> None:
    of, numbers = GateGradients(task.runner, task.calls), np.arange(4, 16)
    plans = np.random.default_rng(0).integers(0, 4, (12, 10, 6)).astype(np.int8)
    plans[:, 0] = plans[::4] = Source.COMPUTE
    there = np.flatnonzero(np.arange(12) % 4)
    assert (plans[there] == Source.ROLLOUT).sum() > 50

    def loss(samples: Sequence[Tensor], calls: Calls) -> Tensor:
        assert len(samples[-1]) == calls.count == 9
        return (samples[-1] - calls.targets).abs().mean()

    value, found = of(plans, numbers, loss)
    gates = nn.functional.one_hot(torch.from_numpy(plans.astype(np.int64)), 4).float().requires_grad_()
    samples = [one[there] for one in naive(of, plans, gates, numbers)]
    expected = loss(samples, task.runner.select(of.calls, numbers[there]))
    (gradient,) = torch.autograd.grad(expected, [gates])
    assert value == pytest.approx(expected.item(), rel=0.01)  # what dense calls computed is there in bfloat16
    assert found[::4].count_nonzero() == 0 and found[there, 1:].count_nonzero() > 1000
    scale = gradient.abs().amax((1, 2, 3), keepdim=True)
    assert ((found - gradient)[there, 1:].abs() <= 0.05 * scale[there]).all()


def test_while_it_is_trained_the_head_is_the_graphs_but_for_a_tenth(task: Task) -> None:
    expected = task.runner.model.logits(task.calls.contexts)
    given = {name: torch.from_numpy(np.array(value)) for name, value in task.pruner.items()}
    whole = DroppedHead(task.runner, 0.0)(task.calls.contexts, given, np.random.default_rng(0))
    torch.testing.assert_close(whole, expected, rtol=1e-4, atol=1e-4)
    dropped = DroppedHead(task.runner)
    draws = torch.stack([dropped(task.calls.contexts, given, np.random.default_rng(n)) for n in range(64)])
    free = expected.abs() < 1e2
    assert (draws[:, free].std(0) > 0).all()
    assert (draws.mean(0) - expected)[free].abs().mean() < 0.2 * draws.std(0)[free].mean() + 0.1


def test_what_is_dropped_is_a_tenth_and_the_rest_grows_for_it(task: Task) -> None:
    dropped = DroppedHead(task.runner)
    dropped._draw = np.random.default_rng(0)
    found = dropped._dropped(torch.ones(100_000))
    assert float((found == 0).float().mean()) == pytest.approx(0.1, abs=0.005)
    assert float(found.max()) == pytest.approx(1 / 0.9)


def test_the_token_of_the_time_is_the_policys_own() -> None:
    config = TransformerConfig(4, 4, 8, 2, cond_dim=3, n_layer=1, n_head=2, n_emb=16)
    network = TransformerForDiffusion(config).eval()
    found = time_tokens(nn.ModuleDict({"model": network}), [7, 3])
    seen = list[Tensor]()
    network.encoder.register_forward_hook(lambda module, given, made: seen.append(made))
    network(torch.zeros(2, 8, 4), torch.tensor([7, 3]), torch.zeros(2, 2, 3))
    assert found is not None
    np.testing.assert_allclose(found, seen[0][:, 0].detach().numpy(), rtol=1e-5, atol=1e-6)
    assert time_tokens(nn.Linear(2, 2), [0]) is None


def trained(task: Task, updates: int, **fields: object) -> Training:
    recipe = {"sources": (Source.TIMESTEP,), "paper": True, "corrected": False, "updates": max(1, updates), **fields}
    training = Training(task, Recipe(**recipe))  # type: ignore[arg-type]
    for _ in range(updates):
        training.update()
    return training


def test_every_array_of_the_head_learns_and_the_budget_is_kept(task: Task) -> None:
    training = trained(task, 3)
    assert training.best.keys() == {name for name in task.pruner if name not in FIXED}
    for name, value in training.best.items():
        if name != BASE and not name.endswith(("k.bias", "self.in.bias")):  # a key's bias changes no share
            assert not np.array_equal(value, task.pruner[name]), name
    plans = training.plans(training.compared, training.best)
    assert (plans == Source.COMPUTE).sum((1, 2)).mean() == pytest.approx(20, abs=1)
    assert set(np.unique(plans)) == {Source.COMPUTE, Source.TIMESTEP}


def test_the_authors_loss_moves_the_share_of_reused_cells_to_the_target(
    task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Far from the target the sparsity loss outweighs the other: its sign is the same for every cell."""
    indifferent = lambda self, plans, numbers, loss: (0.0, torch.zeros(*plans.shape, 4))  # noqa: E731
    monkeypatch.setattr(GateGradients, "__call__", indifferent)
    moved = []
    for source in (Source.COMPUTE, Source.TIMESTEP):  # of all cells after step 0; half of them are to be reused
        training = trained(Task.of(task.runner, task.calls, 30, 0), 0)
        with torch.no_grad():
            training._values["pruner.head.weight"] *= 0.01
            training._values["pruner.head.bias"][source] += 1
        before = training._values["pruner.head.bias"][0].item()
        training.update()
        moved.append(training._values["pruner.head.bias"][0].item() - before)
    assert moved[0] < 0 < moved[1]


def test_first_calls_are_dense_where_rollout_is_read(task: Task) -> None:
    training = trained(task, 1, sources=tuple(Source)[1:])
    plans = training.plans(training.compared, training.best)
    assert (plans[:: task.calls.window] == Source.COMPUTE).all()
    rest = plans[later(training.compared)]
    assert 0 < (rest == Source.COMPUTE).mean() < 1
    assert later(training.compared).tolist() == [n for n in range(training.compared.count) if n % 4]


@pytest.mark.parametrize("reads", [True, False])
def test_a_correction_is_fitted_again_on_the_way_as_calibrations_are(
    task: Task, monkeypatch: pytest.MonkeyPatch, reads: bool
) -> None:
    monkeypatch.setattr(type(task.whole), "reads", lambda self, count: reads)
    training = trained(task, 9, corrected=True)
    assert training.correction is not None
    assert bool(len(training.correction.observed)) == reads
    assert training._practice.runner.correction is training.correction


def test_the_price_leaves_the_cells_that_gain_most() -> None:
    logits = np.zeros((2, 3, 2, 4), np.float32)
    logits[:, 1:, :, 0] = np.arange(8).reshape(2, 2, 2)
    price = price_of(logits, 2 + 1)  # two calls have two cells after step 0
    assert ((logits[:, 1:, :, 0] > price).sum(), price) == (2, 5.5)


def test_rates_are_those_of_the_authors_epochs() -> None:
    assert rate_of(0.0) == pytest.approx(0.01)
    assert rate_of(1 / EPOCHS) == pytest.approx(0.26)
    assert rate_of(WARM / EPOCHS) == 1.0
    assert rate_of(19 / EPOCHS) == pytest.approx(1 - 15 / 41 * 0.99)


@pytest.mark.slow
@pytest.mark.parametrize(("training", "direction"), [("paper", "all"), ("ours", "TIMESTEP")])
def test_a_trained_head_is_executed_by_the_runtimes(
    decoder: Path, tmp_path: Path, training: str, direction: str
) -> None:
    calls, rows = policies.record(tmp_path / "calls.npz", episodes=8), tmp_path / "rows.json"
    sizes = ["--learned", "70", "--judged", "14", "--updates", "4", "--computed-steps", "3", "--json", str(rows)]
    arguments = [str(decoder), "--trajectories", str(calls), "--training", training, "--direction", direction]
    result = CliRunner().invoke(main, [*arguments, *sizes, "--keep", str(tmp_path / "kept")], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    told = json.loads(rows.read_text())
    assert [(row["corrected"], row["updates"]) for row in told["rows"]] == [
        (False, 4),
        (told["rows"][1]["corrected"], 4),
    ]
    assert told["progress"][-1]["update"] == 4
    draw = np.random.default_rng(0)
    observed = {"obs": draw.standard_normal((2, 2, 3), dtype=np.float32)}
    noise = Noise(*(draw.standard_normal((*n, 2, 8, 2), dtype=np.float32) for n in ((), (10,))))
    answers = []
    for runtime in ("reference", "onnxruntime"):
        kept = ttscompile.load(tmp_path / "kept", runtime=runtime)
        answers.append(kept.predict_action(observed, noise)["action"])
        assert kept.last_report is not None and kept.info.default_plan == "found"
        assert max(kept.last_report.computed) < 60
    np.testing.assert_allclose(answers[0], answers[1], rtol=1e-4, atol=1e-4)


def test_a_training_that_runs_out_of_time_keeps_its_last_head(task: Task) -> None:
    training, lines = Training(task, Recipe((Source.TIMESTEP,), True, False, 9)), list[Mapping[str, float]]()
    train(training, 9, 1e-6, lines.append)
    assert training.best and training.done == 1
    assert [line["update"] for line in lines] == [1]


def test_whole_steps_alone_are_measured_too(decoder: Path, tmp_path: Path) -> None:
    calls, rows = policies.record(tmp_path / "calls.npz", episodes=8), tmp_path / "rows.json"
    arguments = [str(decoder), "--trajectories", str(calls), "--training", "none", "--computed-steps", "3"]
    result = CliRunner().invoke(main, [*arguments, "--learned", "70", "--judged", "14", "--json", str(rows)])
    assert result.exit_code == 0, result.output
    told = json.loads(rows.read_text())["rows"]
    assert [row["decided"] for row in told] == ["even steps"] * 2 + ["crowded steps"] * 2
    assert all(row["cells"] == 18 for row in told)


def test_without_a_nonlinearity_gradients_say_what_cells_are_worth(once: Once, tmp_path: Path) -> None:
    module, spec = policies.Mixer(1, linear=True).eval(), policies.spec(clip=None)
    linear, _ = once.compiled("linear mixer", lambda folder: ttscompile.compile_denoiser(module, spec, folder))
    calls = policies.record(tmp_path / "calls.npz", episodes=8)
    arguments = [str(linear), "--trajectories", str(calls), "--computed-steps", "2", "--calls", "8", "--cells", "30"]
    result = CliRunner().invoke(check, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    found = [float(one) for one in re.findall(r"rank correlation (-?[\d.]+)", result.output)]
    assert len(found) == 3 and min(found) > 0.4, result.output
