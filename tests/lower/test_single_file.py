"""The single file of the whole call against the policy that it was made of, and in a process without ttscompile."""

import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import nn

import ttscompile
from tests.lower.whole_call import Episode, groups, inputs, lowered, make, make_toy, policy_groups
from tests.passes.modules import MODULES, spec
from tests.rounding import allowed, assert_equal_but_for_rounding, bound
from tests.runtimes.agreement import call_terms
from tests.runtimes.plans import random_jumps, random_plan, random_reading
from tests.runtimes.toys import pencil_program, toy_program
from ttscompile import Noise, legalize
from ttscompile.artifact import load_artifact
from ttscompile.artifact.bind import LoweredPieces
from ttscompile.artifact.write import write_artifact
from ttscompile.core.correction import INNER, JUMPS, MIDDLE, OBSERVED, OUTER, READING, Correction, no_correction
from ttscompile.core.lattice import Source
from ttscompile.core.plan import Plan
from ttscompile.driver import compile_denoiser
from ttscompile.errors import ArtifactError, LoweringError
from ttscompile.ir.graph import Batch
from ttscompile.ir.program import Program
from ttscompile.lower.joint import lower_all_blocks
from ttscompile.lower.precision import lower_precision
from ttscompile.lower.program import lower_program
from ttscompile.lower.single_file import lower_single_file
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.policy import CompiledPolicy


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"noise": 0.0},  # deterministic: there is no step_noise
        {"sequence_first": True, "steps": 12, "blocks": 13},  # several groups of blocks, the last one smaller
        {"blocks": 2, "pruner": False},  # no step values
        {"steps": 1},
        {"steps": 9, "blocks": 1},
        {"steps": 7, "blocks": 7, "seed": 3},
    ],
)
def test_random_plans_of_all_sources(tmp_path: Path, options: dict[str, Any]) -> None:
    """Each with 9 episodes of 5 calls, of one to three streams."""
    program, policy, model = make_toy(tmp_path, **options)
    terms = call_terms(load_artifact(tmp_path / "artifact"))
    rng = np.random.default_rng(0)
    reads = np.zeros(4, int)
    for streams in (1, 2, 3) * 3:
        policy.reset()
        episode = Episode(model, streams)
        written = np.zeros((program.spec.sampler.steps, len(program.blocks)), np.bool_)
        for _ in range(5):
            plan = random_plan(rng, *written.shape[:1], groups(program), written, rng.uniform(0.05, 0.6))
            obs, noise = inputs(policy, rng, streams)
            expected = policy.predict_action(obs, noise=noise, plan=plan)
            found = episode.call(obs, noise, plan)
            rounding = allowed(expected["action_pred"], terms)
            for name in ("action", "action_pred"):
                np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=rounding)
            np.testing.assert_array_equal(found["executed_plan"], np.stack([plan] * streams))
            written |= plan == Source.COMPUTE
            np.testing.assert_array_equal(episode.index >= 0, np.stack([written] * streams))
            assert len(episode.rows) == written.sum() * streams
            assert sorted(episode.index[episode.index >= 0]) == list(range(len(episode.rows)))
            reads += np.bincount(plan.ravel(), minlength=4)
    if len(program.blocks) > 2 and program.spec.sampler.steps > 1:
        assert (reads > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "read"), [(0.0, 3), (0.1, 3), (0.0, 0)])
def test_a_schedule_with_a_correction(tmp_path: Path, noise: float, read: int) -> None:
    program, policy, model = make_toy(tmp_path, steps=7, noise=noise)
    empty = no_correction(7, program.spec.sample)
    rng = np.random.default_rng(0)
    weights, bias = (rng.normal(0, 0.1, each.shape).astype(np.float32) for each in (empty.weights, empty.bias))
    anchors = np.array([True, False, True, True, False, True, False])
    numbers = load_artifact(tmp_path / "artifact").manifest.condition_numbers
    reading, jumps = random_reading(rng, numbers, empty, read), random_jumps(rng, anchors, program.spec.sample, read)
    correction = Correction(anchors, weights, bias, *reading, *jumps)
    assert correction.reads == read
    assert correction.landings == {1: 0, 4: 1}
    feeds = correction.inputs()
    reference = open_runtime(load_artifact(tmp_path / "artifact"), "reference")
    plan = np.zeros((7, 5), np.int8)
    plan[[2, 3, 5]] = Source.TIMESTEP
    # A correction adds six numbers for each action of the chunk.
    terms = call_terms(load_artifact(tmp_path / "artifact")) + 7 * 6 * program.spec.sample[0]
    for streams in (1, 2):
        reference.reset()
        obs, drawn = inputs(policy, rng, streams)
        normalizer, actions = program.spec.observations["obs"].normalizer, program.spec.chunk.normalizer
        assert normalizer is not None
        assert actions is not None
        normalized = {"obs": normalizer.normalize(obs["obs"])}
        sample, _ = reference.predict(normalized, drawn, Plan(cells=plan, correction=correction))
        found = Episode(model, streams).call(obs, drawn, plan, **feeds)["action_pred"]
        assert_equal_but_for_rounding(found, actions.unnormalize(sample), terms)
        without = Episode(model, streams).call(obs, drawn, plan)["action_pred"]
        assert np.abs(found - without).max() > 1e-2
        blind = {name: value for name, value in feeds.items() if name not in (READING, OBSERVED)}
        apart = np.abs(found - Episode(model, streams).call(obs, drawn, plan, **blind)["action_pred"]).max()
        assert apart > 1e-2 if read else apart == 0
        grounded = {name: value for name, value in feeds.items() if name not in (JUMPS, INNER, MIDDLE, OUTER)}
        assert np.abs(found - Episode(model, streams).call(obs, drawn, plan, **grounded)["action_pred"]).max() > 1e-2


def test_with_a_pencil(tmp_path: Path) -> None:
    _, model = make(pencil_program(), tmp_path)
    obs, noise = {"obs": np.full((1, 1), -32, np.float32)}, Noise(np.full((1, 1, 1), 35, np.float32))
    for second, result in ((Source.TIMESTEP, 41), (Source.FORWARD, 41), (Source.COMPUTE, 44), (Source.ROLLOUT, 41)):
        out = Episode(model, 1).call(obs, noise, np.array([[0], [second]]))
        assert out["action_pred"].item() == result  # a ROLLOUT of nothing is a TIMESTEP
    episode = Episode(model, 1)
    episode.call(obs, noise, np.array([[0], [0]]))  # computes 3 and 6
    assert episode.call(obs, noise, np.array([[0], [3]]))["action_pred"].item() == 44


def test_it_repairs_what_legalize_repairs(tmp_path: Path) -> None:
    program, policy, model = make_toy(tmp_path)
    terms = call_terms(load_artifact(tmp_path / "artifact"))
    rng = np.random.default_rng(0)
    episode = Episode(model, 1)
    written = np.zeros((5, 5), np.bool_)
    repaired = 0
    for _ in range(6):
        plan = rng.integers(0, 4, (5, 5), np.int8)
        legal, _ = legalize(np.where(np.arange(5)[:, None] == 0, 0, plan).astype(np.int8), groups(program), written)
        obs, noise = inputs(policy, rng, 1)
        out = episode.call(obs, noise, plan)
        np.testing.assert_array_equal(out["executed_plan"], legal[None])
        assert out["legalised"].tolist() == [int((legal != plan).sum())]
        repaired += int((legal != plan).sum())
        expected = policy.predict_action(obs, noise=noise, plan=legal)["action"]
        assert_equal_but_for_rounding(out["action"], expected, terms)
        written |= legal == Source.COMPUTE
    assert repaired > 20


def test_what_is_not_kept_is_not_there(tmp_path: Path) -> None:
    _, policy, model = make_toy(tmp_path)
    obs, noise = inputs(policy, np.random.default_rng(0), 1)
    episode = Episode(model, 1)
    dense = np.zeros((5, 5), np.int8)
    out = episode.call(obs, noise, dense, rollout_keep=np.zeros((5, 5), np.bool_))
    assert episode.rows.shape == (0, 1, 3, 4)
    assert (episode.index == -1).all()
    reads = np.full((5, 5), Source.ROLLOUT, np.int8)
    reads[0] = 0
    again = episode.call(obs, noise, reads)
    assert (again["executed_plan"][:, 1:] == Source.TIMESTEP).all()
    assert np.abs(again["action"] - out["action"]).max() > 1e-3


@pytest.mark.slow
def test_blocks_of_another_precision(tmp_path: Path) -> None:
    program = toy_program(blocks=6)
    models = lower_program(program)
    lowered, weights, _ = lower_precision(models, program.weights, "int8")
    lowered |= lower_all_blocks(program.pieces.blocks, {**models, **lowered})
    write_artifact(program, models, tmp_path / "artifact", LoweredPieces("int8", lowered, weights))
    model = lower_single_file(program, {**models, **lowered}, {**program.weights, **weights})
    policy = ttscompile.load(tmp_path / "artifact")
    obs, noise = inputs(policy, np.random.default_rng(0), 2)
    dense = np.zeros((5, 6), np.int8)
    out = Episode(model.SerializeToString(), 2).call(obs, noise, dense)
    expected = policy.predict_action(obs, noise=noise, plan="full")
    np.testing.assert_allclose(out["action"], expected["action"], rtol=1e-4, atol=1e-4)
    fp32 = policy.predict_action(obs, noise=noise, plan="dense")
    assert np.abs(fp32["action"] - expected["action"]).max() > 1e-3


def test_the_same_program_gives_the_same_bytes() -> None:
    program, models, first = lowered()
    second = lower_single_file(program, models, program.weights)
    assert first.SerializeToString(deterministic=True) == second.SerializeToString(deterministic=True)


def renamed(key: str) -> Callable[[Program], Program]:
    def change(program: Program) -> Program:
        spec = program.spec
        return replace(program, spec=replace(spec, observations={key: spec.observations["obs"]}))

    return change


def wider(program: Program) -> Program:
    other = replace(program.blocks[1].type, shape=(Batch(), 3, 5))
    blocks = (program.blocks[0], replace(program.blocks[1], type=other), *program.blocks[2:])
    return replace(program, blocks=blocks)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (renamed("plan"), r"observations \['plan'\] have names of the single file's own"),
        (renamed("action_pred"), r"observations \['action_pred'\]"),
        (wider, "the residual stream changes its type"),
        (lambda p: replace(p, weights={k: v for k, v in p.weights.items() if k != "stem.w"}), "'stem.w' .* no value"),
    ],
)
def test_programs_without_a_single_file(change: Callable[[Program], Program], message: str) -> None:
    program, models, _ = lowered()
    with pytest.raises(LoweringError, match=message):
        lower_single_file(change(program), models, change(program).weights)


def test_two_gigabytes_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    program, models, _ = lowered()
    monkeypatch.setattr("ttscompile.lower.single_file.LARGEST", 1000)
    with pytest.raises(LoweringError, match="an ONNX file holds at most 2"):
        lower_single_file(program, models, program.weights)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.soak] * (n == "U-Net")) for n in MODULES])
def test_the_compiler_writes_it(name: str, compiled_module: Callable[[str], tuple[nn.Module, Path]]) -> None:
    """Of modules that nobody prepared."""
    _, folder = compiled_module(name)
    policy = ttscompile.load(folder / "artifact")
    rng = np.random.default_rng(0)
    episode = Episode(str(folder / "new" / "call.onnx"), 2)
    written = np.zeros(episode.index.shape[1:], np.bool_)
    terms = call_terms(load_artifact(folder / "artifact"))
    for _ in range(3):
        plan = random_plan(rng, len(written), policy_groups(folder / "artifact"), written, 0.3)
        obs, noise = inputs(policy, rng, 2)
        expected = policy.predict_action(obs, noise=noise, plan=plan)
        found = episode.call(obs, noise, plan)
        assert_equal_but_for_rounding(found["action"], expected["action"], terms)
        written |= plan == Source.COMPUTE


@pytest.mark.slow
def test_a_place_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ArtifactError, match="single file cannot be written"):
        compile_denoiser(MODULES["bare observation"]().eval(), spec(), single_file=tmp_path / "file" / "call.onnx")


PLAIN = textwrap.dedent(
    """
    import sys
    import numpy as np, onnxruntime

    given = dict(np.load(sys.argv[2]))
    session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
    shapes = {value.name: value.shape for value in session.get_inputs()}
    rows = np.zeros((0, *shapes["rollout_rows"][1:]), np.float32)
    index = np.full((given["obs"].shape[1], *shapes["rollout_index"][1:]), -1, np.int64)
    keep = np.full(shapes["rollout_keep"], True)
    actions = []
    for r in range(len(given["plan"])):
        feeds = {name: given[name][r] for name in ("obs", "initial_noise", "step_noise", "plan")}
        feeds |= {"rollout_rows": rows, "rollout_index": index, "rollout_keep": keep}
        action, rows, index = session.run(["action", "rollout_rows_next", "rollout_index_next"], feeds)
        actions.append(action)
    assert not [name for name in sys.modules if name.split(".")[0] in ("ttscompile", "torch", "onnx")]
    np.save(sys.argv[3], np.stack(actions))
    """
)


@pytest.mark.slow
@pytest.mark.parametrize("streams", [1, pytest.param(2, marks=pytest.mark.soak)])
def test_the_real_policy_in_a_process_that_never_heard_of_us(
    compiled_pusht: Path, tmp_path: Path, streams: int
) -> None:
    model = compiled_pusht.parent / "call.onnx"
    policy = ttscompile.load(compiled_pusht)
    recorded, expected = recorded_episode(policy, streams)
    np.savez(tmp_path / "given.npz", **recorded)
    command = [sys.executable, "-c", PLAIN, str(model), str(tmp_path / "given.npz"), str(tmp_path / "actions.npy")]
    subprocess.run(command, check=True, cwd=tmp_path)
    found = np.load(tmp_path / "actions.npy")
    assert found.shape == expected.shape == (4, streams, 8, 2)
    # In units of the range of the actions, of which the normaliser makes -1..1.
    normalizer = policy.info.action.normalizer
    assert normalizer is not None
    allowed = bound(call_terms(load_artifact(compiled_pusht))) / 2
    assert (np.abs(found - expected) * np.abs(normalizer.scale) / 2).max() < allowed


def recorded_episode(policy: CompiledPolicy, streams: int) -> tuple[dict[str, Any], np.ndarray]:
    """Four calls: dense, and three plans of all sources; inputs with one row a call, and the actions."""
    rng = np.random.default_rng(streams)
    program_groups = [0, 1, 2] * 8
    written = np.zeros((100, 24), np.bool_)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("obs", "initial_noise", "step_noise", "plan")}
    actions = []
    for r in range(4):
        plan = random_plan(rng, 100, program_groups, written, 0.1 if r else 1.0)
        _, noise = inputs(policy, rng, streams)
        obs = rng.uniform(100, 400, (streams, 2, 20)).astype(np.float32)
        actions.append(policy.predict_action({"obs": obs}, noise=noise, plan=plan)["action"])
        for name, value in zip(rows, (obs, noise.initial, noise.steps, plan[None]), strict=True):
            rows[name].append(np.asarray(value))
        written |= plan == Source.COMPUTE
    return {name: np.stack(values) for name, values in rows.items()}, np.stack(actions)
