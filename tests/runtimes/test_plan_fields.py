"""Plans that are random in all of their fields, in every runtime that can do their parts, against the reference."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

import ttscompile
from tests.calibration import policies
from tests.once import Once
from tests.rounding import bound
from ttscompile import Plan
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.codec import to_json
from ttscompile.artifact.manifest import StartRecord
from ttscompile.artifact.stores import BlockWeights
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import Source
from ttscompile.core.spec import Relative
from ttscompile.errors import IllegalPlanError, RuntimeUnavailableError
from ttscompile.ir.pieces import is_block
from ttscompile.lower.precision import quantize_model
from ttscompile.runtimes import open_runtime
from ttscompile.samplers.flow import flow_matching_table

from .agreement import call_terms, random_inputs
from .plans import random_correction, random_plan

pytestmark = pytest.mark.slow

STEPS = {"original": 6, "euler-4": 4}
STARTS = {"original-last-2": StartRecord("original", 2), "euler-4-last-3": StartRecord("euler-4", 3)}


def in_eight_bits(artifact: Artifact, weights: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the models in int8 make of these weights."""
    known, made = {**artifact.weights, **weights}, dict[str, np.ndarray]()
    record = artifact.manifest.precision
    for piece in filter(is_block, () if record is None else record.models):
        path = artifact.path / artifact.manifest.pieces[piece].file
        made |= quantize_model(onnx.load(path, load_external_data=False), known)[1]
    return made


@pytest.fixture(scope="module")
def artifact(once: Once) -> Artifact:
    """Two loops, two that begin with the chunk before, two sets of weights, blocks in fp32 and in eight bits."""

    def convert(path: Path) -> None:
        tables = {
            name: replace(flow_matching_table(steps), timesteps=np.arange(steps)[::-1].copy())
            for name, steps in STEPS.items()
        }
        spec = replace(policies.spec(), sampler=tables.pop("original"), loops=tables)
        spec = replace(spec, chunk=replace(spec.chunk, relative=Relative("obs", (2, None))))  # starts go on from it
        ttscompile.compile_denoiser(policies.Mixer(0).eval(), spec, path, precision="int8")
        plain, rng = load_artifact(path), np.random.default_rng(0)
        names = {name for piece, graph in plain.graphs.items() if is_block(piece) for name in graph.constants}
        own = {name: plain.weights[name] for name in sorted(names) if plain.weights[name].dtype == np.float32}
        moved = {n: a + np.float32(0.1) * rng.standard_normal(a.shape).astype(np.float32) for n, a in own.items()}
        lower = in_eight_bits(plain, moved)
        held = {"start-2": Plan("original-last-2", np.zeros((2, 6), np.int8), otherwise=plain.plans["dense"])}
        other = Plan("euler-4", np.zeros((4, 6), np.int8))
        held |= {"four": other, "start-3": Plan("euler-4-last-3", np.zeros((3, 6), np.int8), otherwise=other)}
        held |= {"trained": Plan(cells=np.zeros((6, 6), np.int8), weights="trained")}
        plans = {"dense": plain.plans["dense"], **held}
        update_plans(path, plans, "dense", weights={"trained": BlockWeights(moved, lower)}, starts=STARTS)

    return load_artifact(once.folder("all fields of a plan", convert))


def random_fields(rng: np.random.Generator) -> dict[str, Any]:
    """Everything but the cells and the correction."""
    return {
        "loop": str(rng.choice([*STEPS, *STARTS])),
        "weights": str(rng.choice(["original", "trained"])),
        "precision": {} if rng.random() < 0.5 else {"blocks": "int8"},
    }


def with_cells(rng: np.random.Generator, artifact: Artifact, fields: Mapping[str, Any], streams: int) -> Plan:
    """A plan with these fields, and one for calls without a chunk where its loop needs one."""
    start = STARTS.get(fields["loop"])
    otherwise = None if start is None else with_cells(rng, artifact, {**fields, "loop": start.loop}, streams)
    steps = artifact.manifest.steps_of(fields["loop"])
    groups, nothing = artifact.manifest.groups, np.zeros((steps, len(artifact.manifest.groups)), np.bool_)
    cells = np.stack([random_plan(rng, steps, groups, nothing, rng.uniform(0.1, 0.5)) for _ in range(streams)])
    cells[:, 1:][rng.random(cells[:, 1:].shape) < 0.1] = Source.ROLLOUT  # repaired where there is nothing to read
    plan = Plan(cells=cells, otherwise=otherwise, repair=True, **fields)
    if rng.random() < 0.5:
        plan = replace(plan, correction=random_correction(view_of(artifact, plan), rng))
    return plan


@pytest.mark.parametrize("seed", range(8))
def test_any_combination_runs_in_every_runtime_that_can_do_its_parts(artifact: Artifact, seed: int) -> None:
    """Episodes in which every call has a plan of its own: nothing of one variant may be read by another."""
    rng, streams = np.random.default_rng(seed), 1 + seed % 2
    runtimes = {name: open_runtime(artifact, name) for name in ("onnxruntime", "torch", "reference")}
    record = artifact.manifest.precision
    assert record is not None
    ran, drawn = set[tuple[str, str, bool]](), list[dict[str, Any]]()
    carried = set[str]()  # runtimes whose last chunk has something of eight bits in it
    while len(drawn) < 3:  # apart from their precision, too: the reference has them all in fp32
        one = random_fields(rng)
        if all((one["loop"], one["weights"]) != (each["loop"], each["weights"]) for each in drawn):
            drawn.append(one)
    for call in range(12):
        plan = with_cells(rng, artifact, drawn[call // 2 % 3], streams)  # twice the same variant, and it comes again
        obs, noise = random_inputs(artifact, rng, streams)
        expected, wanted = runtimes["reference"].predict(obs, noise, plan.exact)
        scale = np.abs(expected).max()
        for name in ("onnxruntime", "torch"):
            if plan.precision and name == "torch":
                with pytest.raises(RuntimeUnavailableError, match=r"'blocks' in 'int8'"):
                    runtimes[name].predict(obs, noise, plan)
                plan_here = plan.exact
            else:
                plan_here = plan
            found, report = runtimes[name].predict(obs, noise, plan_here)
            eight = bool(plan_here.precision)
            off = eight or (plan.otherwise is not None and name in carried)
            carried = carried | {name} if off else carried - {name}
            allowed = 0.3 if off else 50 * bound(call_terms(artifact))
            assert np.abs(found - expected).max() / scale < allowed, (name, call, plan.variant)
            if not eight:
                np.testing.assert_array_equal(report.plan, wanted.plan)
                assert (report.legalised, report.loop) == (wanted.legalised, wanted.loop)
            ran.add((name, report.loop, eight))
    assert len(ran) >= 4


def test_the_cells_of_a_matrix_are_those_of_the_loop_that_was_loaded(artifact: Artifact) -> None:
    policy = ttscompile.load(artifact.path, plan="four")
    obs = {key: np.concatenate([one.draw(np.random.default_rng(0))]) for key, one in policy.info.observation.items()}
    assert policy.info.K == 4
    policy.predict_action(obs, plan=np.zeros((4, 6), np.int8))
    with pytest.raises(IllegalPlanError, match=r"expected \[K, blocks\] = \(4, 6\)"):
        policy.predict_action(obs, plan=np.zeros((6, 6), np.int8))
    policy.predict_action(obs, plan="dense")
    assert policy.last_report is not None
    assert (policy.last_report.loop, policy.last_report.plan.shape) == ("original", (1, 6, 6))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"loop": "ddim-3"}, r"no loop 'ddim-3'; it has \['original', 'euler-4', 'original-last-2'"),
        ({"weights": "mine"}, r"no weights 'mine'; it has \['original', 'trained'\]"),
        ({"tokens": ttscompile.TokenReuse(0.1, 8)}, "no image encoder of this policy has tokens"),
        ({"loop": 3}, "a plan's loop: expected a name; found 3"),
    ],
)
def test_a_plan_that_names_what_is_not_there_is_refused_by_its_name(
    artifact: Artifact, fields: dict[str, Any], message: str
) -> None:
    policy = ttscompile.load(artifact.path)
    obs = {key: one.draw(np.random.default_rng(0)) for key, one in policy.info.observation.items()}
    with pytest.raises(IllegalPlanError, match=message):
        policy.predict_action(obs, plan=Plan(cells=np.zeros((6, 6), np.int8), **fields))


def test_a_copy_is_the_same(artifact: Artifact, tmp_path: Path) -> None:
    """Plans, loops and weights come back from disk as they were."""
    shutil.copytree(artifact.path, tmp_path / "copy")
    again = load_artifact(tmp_path / "copy")
    assert to_json(again.manifest) == to_json(artifact.manifest)
    manifest = update_plans(tmp_path / "copy", again.plans, "four")
    assert manifest.plans == artifact.manifest.plans
    assert manifest.identity != artifact.manifest.identity


def test_a_plan_that_has_a_name_stays_what_it_is(artifact: Artifact) -> None:
    for cells in (plan.cells for plan in artifact.plans.values() if plan.cells is not None):
        with pytest.raises(ValueError, match="read-only"):
            cells[:] = 1


def test_a_part_that_is_said_to_be_in_fp32_is_not_named(artifact: Artifact) -> None:
    assert dict(replace(artifact.plans["dense"], precision={"blocks": "fp32", "condition": "int8"}).precision) == {
        "condition": "int8"
    }


def test_what_a_plan_falls_back_on_is_in_the_precision_that_is_named(artifact: Artifact) -> None:
    for name, other in (("start-3", "four"), ("start-2", "dense")):
        for precision in ("int8", "int8+blocks", "bf16", "fp32"):
            plan, first = artifact.plan(f"{name}@{precision}"), artifact.plan(f"{other}@{precision}")
            assert plan.otherwise is first and artifact.told(first) == f"{other}@{precision}"
            assert dict(plan.precision) == dict(first.precision)


def test_what_an_exact_plan_falls_back_on_is_exact(artifact: Artifact) -> None:
    """Where the plan itself is in fp32 already, too; what is exact stays what it is."""
    narrow = replace(artifact.plans["four"], precision={"blocks": "int8"})
    plan = replace(artifact.plan("start-3"), precision={}, tokens=None, otherwise=narrow)
    exact = plan.exact
    assert exact.otherwise is not None and not exact.otherwise.precision
    assert exact.exact is exact and artifact.plans["dense"].exact is artifact.plans["dense"]
    open_runtime(artifact, "reference", plan=exact)
