"""The module that makes its own plan: the actions of the policy, as it stands and exported, and what it skips."""

import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.fx import GraphModule

import ttscompile
from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Noise, Plan, Source
from ttscompile.artifact import load_artifact
from ttscompile.artifact.stores import BlockWeights
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import uniform_plan
from ttscompile.errors import IllegalPlanError, ObservationError
from ttscompile.ir.program import Program
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.torch.module import PrunedCall, Rollout

from .agreement import call_terms
from .pruners import calibrated, random_pruner
from .toys import random_sampler, toy_program, written_artifact

pytestmark = pytest.mark.slow

NO_COMPILER = "NO C++ COMPILER: the exported module was not compiled; install g++"

Inputs = tuple[dict[str, Tensor], Tensor, Tensor]
Plain = tuple[Program, PrunedCall, CompiledPolicy, float]


def made(program: Program, folder: Path, corrected: bool = True) -> tuple[PrunedCall, CompiledPolicy, float]:
    """The module, the reference runtime, and the terms of a call: actions are divided by a scale of a half at least."""
    written_artifact(program, folder)
    calibrated(folder, program, corrected)
    terms = 4 * call_terms(load_artifact(folder)) + 7 * 6 * program.spec.sample[0] * program.spec.sampler.steps
    return ttscompile.to_module(folder, "pruner"), ttscompile.load(folder, "reference"), terms


def draw(program: Program, streams: int, rng: np.random.Generator) -> Inputs:
    shapes = (streams, 2), (streams, *program.spec.sample), (program.spec.sampler.steps, streams, *program.spec.sample)
    obs, initial, steps = (torch.from_numpy(rng.standard_normal(shape, dtype=np.float32)) for shape in shapes)
    return {"obs": obs}, initial, steps


def expected(policy: CompiledPolicy, given: Inputs) -> tuple[np.ndarray, np.ndarray]:
    obs, initial, steps = given
    noise = Noise(initial.numpy(), steps.numpy() if policy.info.stochastic else None)
    actions = policy.predict_action({"obs": obs["obs"].numpy()}, noise=noise, plan="pruner")["action_pred"]
    report = policy.last_report
    assert report is not None
    return np.asarray(actions), report.plan


def episodes(
    program: Program, module: Any, policy: CompiledPolicy, terms: float, cache: Rollout, seeds: tuple[int, ...]
) -> tuple[np.ndarray, set[bytes]]:
    """Compare episodes of four calls each; how often each source occurred, and the plans."""
    reads, plans = np.zeros(4, int), set[bytes]()
    for seed in seeds:
        policy.reset()
        rng, rollout = np.random.default_rng(seed), cache
        for _ in range(4):
            given = draw(program, len(cache[1]), rng)
            with torch.no_grad():
                actions, plan, rollout = module(*given, rollout)
            wanted, executed = expected(policy, given)
            np.testing.assert_array_equal(plan, executed)
            assert_equal_but_for_rounding(actions, wanted, terms)
            reads += np.bincount(executed.ravel(), minlength=4)
            plans |= {one.tobytes() for one in executed}
    assert not cache[0].any()  # nothing is written into what was given
    return reads, plans


VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {"steps": 6},
    "batch in the middle": {"steps": 5, "blocks": 7, "sequence_first": True, "normed": True},
    "no step values": {"blocks": 2},
    "memory and clip": {"steps": 6},
}


def variant(name: str, **fewer: int) -> Program:
    program = toy_program(**VARIANTS[name] | fewer)
    if name != "memory and clip":
        return program
    return replace(program, spec=replace(program.spec, sampler=random_sampler(6, 3, memories=1, clip=0.3)))


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("streams", [1, 3])
def test_episodes_of_its_plans(tmp_path: Path, name: str, streams: int) -> None:
    program = variant(name)
    module, policy, terms = made(program, tmp_path / "artifact", corrected=name != "no step values")
    assert not module.training and not list(module.parameters())
    reads, plans = episodes(program, module, policy, terms, module.empty_rollout(streams), (0, 1))
    assert (reads > 0).all()
    assert len(plans) > 4 * streams


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.soak) if name == "plain" else name for name in VARIANTS]
)  # ``exported`` is the plain one
def test_exported_it_computes_the_same(tmp_path: Path, name: str) -> None:
    """For two streams, whose plans differ. A block takes torch two seconds to export: there are three at most."""
    program = variant(name, blocks=min(3, len(variant(name).blocks)))
    module, policy, terms = made(program, tmp_path / "artifact", corrected=name != "no step values")
    empty = module.empty_rollout(2)
    with torch.no_grad():
        exported = torch.export.export(module, (*draw(program, 2, np.random.default_rng(9)), empty))
    reads, plans = episodes(program, exported.module(), policy, terms, empty, (0, 1, 2))
    assert (reads > 0).all()
    assert len(plans) > 12


def test_exported_its_first_step_has_the_original_weights(tmp_path: Path) -> None:
    program, rng = toy_program(steps=3, blocks=2), np.random.default_rng(0)
    artifact = written_artifact(program, tmp_path / "artifact")
    own = {name: rng.standard_normal((4, 4)).astype(np.float32) for name in ("block.0.w", "block.1.w")}
    plans = {"pruner": Plan(cells=None, weights="trained", repair=True)}
    weights = {"trained": BlockWeights(own, {})}
    update_plans(artifact.path, plans, "pruner", weights=weights, pruner_weights=random_pruner(program, 2))
    policy, module = ttscompile.load(artifact.path, "reference"), ttscompile.to_module(artifact.path, "pruner")
    given = draw(program, 2, rng)
    with torch.no_grad():
        found, plan = torch.export.export(module, given).module()(*given)
    wanted, executed = expected(policy, given)
    np.testing.assert_array_equal(plan, executed)
    assert_equal_but_for_rounding(found, wanted, 4 * call_terms(load_artifact(artifact.path)))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Plain:
    program = toy_program(steps=6, blocks=3)
    return program, *made(program, tmp_path_factory.mktemp("pruned") / "artifact")


@pytest.fixture(scope="module")
def exported(plain: Plain) -> torch.export.ExportedProgram:
    """For one stream, and without residuals of earlier calls."""
    with torch.no_grad():
        return torch.export.export(plain[1], draw(plain[0], 1, np.random.default_rng(9)))


def test_without_a_rollout_cache_every_call_is_the_first_of_an_episode(
    plain: Plain, exported: torch.export.ExportedProgram
) -> None:
    program, module, policy, terms = plain
    rng, repaired = np.random.default_rng(0), 0
    for _ in range(4):
        policy.reset()
        given = draw(program, 1, rng)
        wanted, executed = expected(policy, given)
        report = policy.last_report
        assert report is not None
        repaired += sum(report.legalised)
        for call in (module, exported.module()):
            with torch.no_grad():
                actions, plan = call(*given)
            np.testing.assert_array_equal(plan, executed)
            assert_equal_but_for_rounding(actions, wanted, terms)
    assert repaired > 0


@pytest.mark.parametrize("form", ["as it stands", "exported"])
def test_a_block_that_is_reused_is_not_evaluated(
    plain: Plain, exported: torch.export.ExportedProgram, form: str
) -> None:
    """Each block of the toy has one tanh, and nothing else has one."""
    program, module, _, _ = plain
    call, rng, counts = module if form == "as it stands" else exported.module(), np.random.default_rng(1), []
    for _ in range(3):
        given = draw(program, 1, rng)
        with torch.no_grad(), torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
            plan = call(*given)[1]
        evaluated = Counter({event.key: event.count for event in profile.key_averages()})["aten::tanh"]
        assert evaluated == int((plan == Source.COMPUTE.value).sum())
        counts.append(evaluated)
    assert len(set(counts)) > 1 and max(counts) < plan.numel()


def graphs(graph: GraphModule) -> Iterator[GraphModule]:
    """A graph and all that are in it, at any depth."""
    yield graph
    for inner in graph.children():
        if isinstance(inner, GraphModule):
            yield from graphs(inner)


def called(graph: GraphModule, name: str) -> list[Any]:
    """The nodes of torch.fx that call an operation; what their arguments are is for the caller to know."""
    return [node for node in graph.graph.nodes if node.op == "call_function" and str(node.target) == name]


def test_the_head_and_the_branches_are_in_the_exported_program(
    plain: Plain, exported: torch.export.ExportedProgram
) -> None:
    program, module, _, _ = plain
    whole = exported.graph_module
    (loop,) = called(whole, "while_loop")
    assert len(called(whole, "aten.argmax.default")) == 1
    head = program.pieces.pruner
    assert head is not None
    buffers = {target: name for name, target in exported.graph_signature.inputs_to_buffers.items()}
    nodes = {node.name: node for node in whole.graph.nodes}
    for constant in head.constants:
        assert nodes[buffers[module._names[f"weight/{constant}"]]].users
    body = whole.get_submodule(loop.args[1].target)
    choices = called(body, "cond")
    branches = [[body.get_submodule(each.target) for each in node.args[1:3]] for node in choices]
    blocks = [pair for pair in branches if called(pair[0], "aten.tanh.default")]
    assert len(blocks) == len(program.blocks) == 3
    assert len(branches) == 4  # the other one is for jumps
    for computing, reusing in blocks:
        assert len(called(computing, "aten.tanh.default")) == 1
        operations = {str(node.target) for node in reusing.graph.nodes if node.op == "call_function"}
        assert operations == {"aten.clone.default"}
    assert sum(len(called(one, "aten.tanh.default")) for one in graphs(whole)) == 3


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # of torch's compiler, about itself
def test_what_is_exported_can_be_compiled_and_run_without_python(
    plain: Plain, exported: torch.export.ExportedProgram, tmp_path: Path
) -> None:
    if shutil.which("g++") is None:
        pytest.skip(NO_COMPILER)
    program, _, policy, terms = plain
    package = torch._inductor.aoti_compile_and_package(exported, package_path=str(tmp_path / "call.pt2"))
    compiled = torch._inductor.aoti_load_package(package)
    for seed in range(3):
        policy.reset()
        given = draw(program, 1, np.random.default_rng(seed))
        actions, plan = compiled(*given)
        wanted, executed = expected(policy, given)
        np.testing.assert_array_equal(plan, executed)
        assert_equal_but_for_rounding(actions, wanted, terms)


def test_a_broken_pruner_is_said(plain: Plain, exported: torch.export.ExportedProgram) -> None:
    """An exported program raises nothing: its actions are NaN."""
    program, module, _, _ = plain
    given, name = draw(program, 1, np.random.default_rng(0)), module._names["weight/pruner.b"]
    both = [module, exported.module()]
    fine = [call.get_buffer(name).clone() for call in both]
    try:
        for call in both:
            call.get_buffer(name)[7] = np.nan
        with pytest.raises(IllegalPlanError, match="logits hold NaN"):
            module(*given)
        assert both[1](*given)[0].isnan().all()
    finally:
        for call, value in zip(both, fine, strict=True):
            call.get_buffer(name).copy_(value)
    assert all(call(*given)[0].isfinite().all() for call in both)


def test_a_rollout_cache_of_other_streams_is_refused(plain: Plain) -> None:
    program, module, _, _ = plain
    given = draw(program, 1, np.random.default_rng(0))
    with pytest.raises(ObservationError, match=r"expected residuals .*\[6, 3, 1, 3, 4\]; found .*\[6, 3, 2, 3, 4\]"):
        module(*given, module.empty_rollout(2))
    residuals, written = module.empty_rollout(1)
    with pytest.raises(ObservationError, match="expected written torch.bool .* found torch.uint8"):
        module(*given, (residuals, written.to(torch.uint8)))


def test_it_is_the_module_of_a_default_plan_that_the_pruner_makes(tmp_path: Path) -> None:
    program = toy_program()
    written_artifact(program, tmp_path / "artifact")
    schedules = {"evenly": uniform_plan(5, 5, 2)}
    with pytest.raises(IllegalPlanError, match=r"no plan 'pruner'; it has \['dense'\]"):
        ttscompile.to_module(tmp_path / "artifact", "pruner")
    store_schedules(tmp_path / "artifact", random_pruner(program, 0), schedules, "made", {})
    assert isinstance(ttscompile.to_module(tmp_path / "artifact"), PrunedCall)
    assert not isinstance(ttscompile.to_module(tmp_path / "artifact", "evenly"), PrunedCall)
