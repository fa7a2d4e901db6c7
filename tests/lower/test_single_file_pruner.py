"""The pruner in the single file: the plans that it makes, executed, against the reference runtime."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import GraphProto
from onnxruntime.capi.onnxruntime_pybind11_state import InvalidArgument

import ttscompile
from tests.lower.whole_call import Episode, inputs, lowered, make_toy, opened
from tests.rounding import assert_equal_but_for_rounding
from tests.runtimes.agreement import call_terms
from tests.runtimes.pruners import calibrated, random_pruner
from tests.runtimes.toys import toy_program
from ttscompile.artifact import load_artifact
from ttscompile.artifact.stores import BlockWeights
from ttscompile.artifact.write import update_plans, write_artifact
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import IllegalPlanError
from ttscompile.lower.program import lower_program
from ttscompile.runtimes.single_file import inputs_of


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "corrected"),
    [
        ({"steps": 6}, True),
        ({"noise": 0.0, "sequence_first": True, "steps": 5, "blocks": 7}, True),
        ({"blocks": 2}, False),  # no step values
    ],
)
def test_episodes_of_its_plans(tmp_path: Path, options: dict[str, Any], corrected: bool) -> None:
    """All sources, a plan for each stream, residuals of earlier calls, and a schedule in between."""
    program, _, model = make_toy(tmp_path, **options)
    folder = calibrated(tmp_path / "artifact", program, corrected)
    policy = ttscompile.load(folder, "reference")
    assert policy.info.default_plan == "pruner"
    terms = 4 * call_terms(load_artifact(folder)) + 7 * 6 * program.spec.sample[0] * program.spec.sampler.steps
    rng, reads, repaired, seen, plans = np.random.default_rng(0), np.zeros(4, int), 0, 0, set()
    given = {name: inputs_of(folder, name) for name in ("pruner", "evenly")}
    for streams in (1, 3, 2):
        policy.reset()
        episode = Episode(model, streams)
        for call in range(4):
            name = "evenly" if call == 2 else "pruner"
            obs, noise = inputs(policy, rng, streams)
            expected = policy.predict_action(obs, noise=noise, plan=name)
            found = episode.call(obs, noise, **given[name])
            report = policy.last_report
            assert report is not None
            np.testing.assert_array_equal(found["executed_plan"], report.plan)
            assert found["legalised"].tolist() == list(report.legalised)
            assert_equal_but_for_rounding(found["action_pred"], expected["action_pred"], terms)
            np.testing.assert_array_equal(found["action"], found["action_pred"][:, 1:])
            if name == "pruner":
                reads += np.bincount(report.plan.ravel(), minlength=4)
                repaired += sum(report.legalised)
                plans |= {plan.tobytes() for plan in report.plan}
                seen += streams
    assert (reads > 0).all()
    assert repaired > 0
    assert len(plans) > seen / 2


def test_older_versions_of_onnxruntime_open_it(tmp_path: Path) -> None:
    """Before 1.31 there is no Where of eight-bit integers, of which plans are."""
    _, _, model = make_toy(tmp_path, steps=3)
    graph = onnx.shape_inference.infer_shapes(onnx.load_from_string(model)).graph
    kinds = {one.name: one.type.tensor_type.elem_type for one in graph.value_info}
    chosen = [kinds[node.output[0]] for node in graph.node if node.op_type == "Where" and node.output[0] in kinds]
    assert chosen and onnx.TensorProto.INT8 not in chosen


@pytest.mark.parametrize("options", [{"steps": 6}, {"steps": 5, "blocks": 7, "sequence_first": True}])
def test_what_inputs_of_gives_is_all_but_observation_and_noise(tmp_path: Path, options: dict[str, Any]) -> None:
    """Calls of an episode; the later ones read residuals of the first."""
    program, policy, model = make_toy(tmp_path, **options)
    folder = calibrated(tmp_path / "artifact", program, corrected=False)
    session, rng, reads = opened(model), np.random.default_rng(0), 0
    policy = ttscompile.load(folder, "reference")
    given, kept = inputs_of(folder, "pruner", streams=2), ("rollout_rows", "rollout_index")
    for _ in range(4):
        obs, noise = inputs(policy, rng, 2)
        noises = {"initial_noise": noise.initial, "step_noise": noise.steps}
        names = ["action", "executed_plan", *(f"{name}_next" for name in kept)]
        action, executed, *following = session.run(names, {**obs, **noises, **given})
        expected = policy.predict_action(obs, noise=noise, plan="pruner")["action"]
        assert_equal_but_for_rounding(action, expected, 4 * call_terms(load_artifact(folder)))
        given |= dict(zip(kept, following, strict=True))
        reads += int((executed == Source.ROLLOUT).sum())
    assert reads > 0


def test_streams_of_one_plan_go_together_and_others_do_not_see_it(tmp_path: Path) -> None:
    """Two streams of one observation and a third: each has the actions that it has alone."""
    program, policy, model = make_toy(tmp_path)
    given = inputs_of(calibrated(tmp_path / "artifact", program, corrected=False))
    terms = call_terms(load_artifact(tmp_path / "artifact"))
    obs, noise = inputs(policy, np.random.default_rng(5), 3)
    obs["obs"][2] = obs["obs"][0]
    found = Episode(model, 3).call(obs, noise, **given)
    assert (found["executed_plan"][0] == found["executed_plan"][2]).all()
    assert (found["executed_plan"][0] != found["executed_plan"][1]).any()
    assert noise.steps is not None
    for s in range(3):
        one = ttscompile.Noise(noise.initial[s : s + 1], noise.steps[:, s : s + 1])
        alone = Episode(model, 1).call({"obs": obs["obs"][s : s + 1]}, one, **given)
        np.testing.assert_array_equal(alone["executed_plan"][0], found["executed_plan"][s])
        assert_equal_but_for_rounding(found["action_pred"][s], alone["action_pred"][0], terms)


def test_a_plan_of_the_caller_for_each_stream(tmp_path: Path) -> None:
    _, policy, model = make_toy(tmp_path, pruner=False)
    obs, noise = inputs(policy, np.random.default_rng(0), 2)
    plans = np.stack([uniform_plan(5, 5, n) for n in (2, 5)])
    expected = policy.predict_action(obs, noise=noise, plan=plans)["action_pred"]
    found = Episode(model, 2).call(obs, noise, plans)
    np.testing.assert_array_equal(found["executed_plan"], plans)
    assert found["legalised"].tolist() == [0, 0]
    assert_equal_but_for_rounding(found["action_pred"], expected, call_terms(load_artifact(tmp_path / "artifact")))


def test_weights_that_are_left_out_are_those_that_were_converted(tmp_path: Path) -> None:
    """And the plan that is given is not looked at."""
    program, policy, model = make_toy(tmp_path)
    obs, noise = inputs(policy, np.random.default_rng(0), 1)
    plan, used = np.full((1, 5, 5), Source.TIMESTEP, np.int8), np.array(True)
    found = Episode(model, 1).call(obs, noise, plan, use_pruner=used)
    own = {name: np.asarray(program.weights[name]) for name in ("pruner.w", "pruner.b", "pruner.mask")}
    both = (own, random_pruner(program, 0))
    same, other = (Episode(model, 1).call(obs, noise, plan, use_pruner=used, **weights) for weights in both)
    np.testing.assert_array_equal(found["executed_plan"], same["executed_plan"])
    np.testing.assert_array_equal(found["action"], same["action"])
    assert (found["executed_plan"] != other["executed_plan"]).any()
    assert (Episode(model, 1).call(obs, noise, plan)["executed_plan"][0, 1:] == Source.TIMESTEP).all()


def test_a_broken_pruner_gives_no_actions(tmp_path: Path) -> None:
    program, policy, model = make_toy(tmp_path)
    obs, noise = inputs(policy, np.random.default_rng(0), 2)
    given, weights = np.zeros((5, 5), np.int8), random_pruner(program, 0)
    fine = Episode(model, 2).call(obs, noise, given, use_pruner=np.array(True), **weights)
    weights["pruner.b"][7] = np.nan
    found = Episode(model, 2).call(obs, noise, given, use_pruner=np.array(True), **weights)
    assert np.isfinite(fine["action_pred"]).all()
    assert np.isnan(found["action_pred"]).all()
    assert np.isfinite(Episode(model, 2).call(obs, noise, given, **weights)["action_pred"]).all()  # nobody asked it


def test_a_policy_without_a_pruner_has_no_such_input(tmp_path: Path) -> None:
    _, policy, model = make_toy(tmp_path, pruner=False)
    obs, noise = inputs(policy, np.random.default_rng(0), 1)
    names = {value.name for value in onnx.load_model_from_string(model).graph.input}
    assert not [name for name in names if "pruner" in name]
    with pytest.raises(InvalidArgument, match="use_pruner"):
        Episode(model, 1).call(obs, noise, np.zeros((5, 5)), use_pruner=np.array(True))
    with pytest.raises(IllegalPlanError, match=r"has no plan 'pruner'; it has \['dense'\]"):
        inputs_of(tmp_path / "artifact", "pruner")


def test_a_plan_with_weights_of_its_own_is_refused(tmp_path: Path) -> None:
    make_toy(tmp_path)
    own = BlockWeights({"block.0.w": np.zeros((4, 4), np.float32)}, {})
    evenly = Plan(cells=uniform_plan(5, 5, 2))
    plans = {"evenly": evenly, "weights": replace(evenly, weights="weights")}
    update_plans(tmp_path / "artifact", plans, "weights", weights={"weights": own})
    with pytest.raises(IllegalPlanError, match="plan 'weights' has weights of its own"):
        inputs_of(tmp_path / "artifact")
    np.testing.assert_array_equal(inputs_of(tmp_path / "artifact", "evenly")["plan"], uniform_plan(5, 5, 2)[None])


def test_a_plan_in_another_loop_than_the_file_is_refused(tmp_path: Path) -> None:
    """Of as many steps, with which the file would compute something else."""
    program = toy_program()
    own, loops = program.spec.sampler, {"other-5": program.pieces.tables}
    program = replace(program, spec=replace(program.spec, loops={"other-5": replace(own, timesteps=own.timesteps * 2)}))
    program = replace(program, pieces=replace(program.pieces, loop_tables=loops))
    for name, loop in (("asked", "other-5"), ("own", "original")):
        write_artifact(program, lower_program(program), tmp_path / name, loop=loop)
        plans = dict(load_artifact(tmp_path / name).plans)
        plans["best"] = Plan("other-5", uniform_plan(5, 5, 2))
        update_plans(tmp_path / name, plans, "best")
    assert inputs_of(tmp_path / "asked")["plan"].shape == inputs_of(tmp_path / "own", "dense")["plan"].shape
    with pytest.raises(
        IllegalPlanError, match="is 2 of 5 steps of other-5, and a single file .* is of loop 'original'"
    ):
        inputs_of(tmp_path / "own")
    with pytest.raises(IllegalPlanError, match="'dense' is 5 of 5 steps of original, and a single file .* 'other-5'"):
        inputs_of(tmp_path / "asked", "dense")


def graphs(graph: GraphProto) -> Iterator[GraphProto]:
    """A graph and all that are in it, at any depth."""
    yield graph
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                yield from graphs(attribute.g)


def test_the_head_and_the_branches_are_in_the_file() -> None:
    """Of the head every operation and constant, in a branch; of each block one that computes and one that reuses."""
    _, models, model = lowered(blocks=8)
    parts = {graph.name: graph for graph in graphs(model.graph)}
    assert {f"block_{b:02d}{end}" for b in range(8) for end in ("", "_reused")} <= parts.keys()
    head = parts["pruner"]
    operations = [node.op_type for node in models["pruner"].graph.node]
    assert operations
    assert [node.op_type for node in head.node][: len(operations)] == operations
    assert "ArgMax" in [node.op_type for node in head.node]
    read = {name for node in head.node for name in node.input}
    assert {"pruner.w", "pruner.b", "pruner.mask"} <= read & {value.name for value in model.graph.input}
    (asked,) = [node for node in model.graph.node if node.op_type == "If" and "use_pruner" in node.input]
    asked_for = {attribute.name: attribute.g.name for attribute in asked.attribute}
    assert asked_for == {"then_branch": "pruner", "else_branch": "given_plan"}
    _, _, without = lowered(blocks=8, pruner=False)
    assert "pruner" not in {graph.name for graph in graphs(without.graph)}
