"""What of an artifact its plans use, and what none of them does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from tests.plans import store_schedules
from tests.runtimes.plans import random_correction
from tests.runtimes.toys import toy_program, written_artifact
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.cli import main
from ttscompile.core.lattice import dense_plan, uniform_plan
from ttscompile.core.plan import ORIGINAL, Plan
from ttscompile.ir.plan_head import first_numbers
from ttscompile.report.usage import BRANCH, CONTEXTS, HEAD, TABLE, told_unused, usage_table, uses
from ttscompile.runtimes.liveness import sources_of_pruner


@pytest.fixture(scope="module")
def converted(tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    return written_artifact(toy_program(), tmp_path_factory.mktemp("usage") / "artifact")


@pytest.fixture
def own(converted: Artifact, tmp_path: Path) -> Artifact:
    return load_artifact(shutil.copytree(converted.path, tmp_path / "artifact"))


def plans_of(artifact: Artifact) -> dict[tuple[str, str, int | str | None], tuple[str, ...]]:
    return {(use.kind, use.name, use.of): use.plans for use in uses(artifact)}


def test_an_artifact_that_was_only_converted_uses_no_head_and_no_reuse(converted: Artifact) -> None:
    found = plans_of(converted)
    idle = (BRANCH, "steps without a computed block", None)
    assert found[HEAD, "the pruner", None] == ()
    assert [found[BRANCH, "COMPUTE", b] for b in range(5)] == [("dense",)] * 5
    reuse = [found[BRANCH, source, b] for source in ("FORWARD", "TIMESTEP", "ROLLOUT") for b in range(5)]
    assert reuse == [()] * 15
    assert found[TABLE, CONTEXTS, "row"] == found[TABLE, CONTEXTS, "time"] == ("dense",)
    assert found[idle] == ()
    assert len(found) == 1 + 20 + 1 + 2
    assert sum(not use.plans for use in uses(converted)) == 17
    assert told_unused(converted) == "17 of 24 heads, branches and tables are used by no plan of the artifact."


def test_what_schedules_use(own: Artifact) -> None:
    """One that reuses whole steps, and one cell each of another source."""
    single = dense_plan(5, 5)
    single[3, 1], single[4, 2] = 1, 3
    schedules = {"evenly": uniform_plan(5, 5, 2), "single": single}
    rng = np.random.default_rng(0)
    corrections = {"evenly": replace(random_correction(own, rng), late=random_correction(own, rng))}
    store_schedules(own.path, None, schedules, "evenly", {}, corrections=corrections)
    artifact = load_artifact(own.path)
    found = plans_of(artifact)
    assert found[BRANCH, "COMPUTE", 0] == ("dense", "evenly", "single")
    assert [found[BRANCH, "FORWARD", b] for b in range(5)] == [(), ("single",), (), (), ()]
    assert [found[BRANCH, "ROLLOUT", b] for b in range(5)] == [(), (), ("single",), (), ()]
    timesteps = [found[BRANCH, "TIMESTEP", b] for b in range(5)]  # block 2 of "single" in the first call of an episode
    assert timesteps == [("evenly",), ("evenly",), ("evenly", "single"), ("evenly",), ("evenly",)]
    assert found[BRANCH, "steps without a computed block", None] == ("evenly",)
    assert found[TABLE, "correction of evenly", None] == found[TABLE, "jumps of evenly", None] == ("evenly",)
    assert found[TABLE, "correction with a prefix of evenly", None] == ("evenly",)
    assert found[HEAD, "the pruner", None] == ()
    rows = [row for row in usage_table(artifact).rows if "FORWARD" in row[0] or "TIMESTEP" in row[0]]
    assert rows == [
        ("branch: FORWARD of blocks 0, 2, 3, 4 (4)", "no plan: unused"),
        ("branch: FORWARD of blocks 1 (1)", "single"),
        ("branch: TIMESTEP of blocks 0, 1, 3, 4 (4)", "evenly"),
        ("branch: TIMESTEP of blocks 2 (1)", "evenly, single"),
    ]


def test_a_pruner_uses_what_it_can_choose(own: Artifact) -> None:
    """Of the toy's, which nobody knows, everything but reuse in step 0."""
    store_schedules(own.path, dict(own.pruner), {}, "pruner", {})
    artifact = load_artifact(own.path)
    assert {use.plans for use in uses(artifact) if use.kind == HEAD} == {("pruner",)}
    assert all("pruner" in use.plans for use in uses(artifact) if use.kind == BRANCH)
    assert told_unused(artifact) == "Each of the 24 heads, branches and tables is used by a plan."


def test_the_sources_that_a_head_of_ours_can_choose(own: Artifact) -> None:
    """As it is put in it is dense; one number more, and one cell can be FORWARD; and at -1 nothing else changes."""
    head = first_numbers(4, 8, 2, 5, 5)
    made = view_of(replace(own, pruners={ORIGINAL: head}), Plan(cells=None))  # only its numbers are read
    assert sources_of_pruner(made)[..., 0].all()
    assert not sources_of_pruner(made)[..., 1:].any()
    head["pruner.base"][2, 3, 1] = 4.0
    head["pruner.base"][1, 1] = (-100, -100, 100, -100)
    possible = sources_of_pruner(made)
    assert np.argwhere(possible[..., 1:]).tolist() == [[1, 1, 1], [2, 3, 0]]
    assert np.argwhere(~possible[..., 0]).tolist() == [[1, 1]]


def test_inspect_says_it(converted: Artifact) -> None:
    told = CliRunner().invoke(main, ["inspect", str(converted.path)], catch_exceptions=False).stdout
    assert "the pruner" in told and "no plan: unused" in told
    assert "17 of 24 heads, branches and tables are used by no plan of the artifact." in " ".join(told.split())
    as_json = CliRunner().invoke(main, ["inspect", str(converted.path), "--json"], catch_exceptions=False).stdout
    listed = json.loads(as_json)["uses"]
    assert {"kind": "head", "name": "the pruner", "plans": [], "of": None} in listed
    assert sum(not use["plans"] for use in listed) == 17
