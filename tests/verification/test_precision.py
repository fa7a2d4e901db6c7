"""Plans of an artifact with int8 blocks are verified as ``load`` runs them, not in fp32 alone."""

from dataclasses import replace
from pathlib import Path

import pytest

import ttscompile
from tests.plans import store_schedules
from tests.rounding import PROMISED
from ttscompile.artifact.golden import GoldenPlan, load_golden, load_golden_plans
from ttscompile.artifact.load import load_artifact
from ttscompile.core.lattice import Source
from ttscompile.runtimes import open_runtime
from ttscompile.verification.precision import check_plans_precision
from ttscompile.verification.record_golden import record_plans
from ttscompile.verification.rung import FAILED, PASSED, Rung

from . import policy

RUNG = "precision of plans"


@pytest.fixture(scope="module")
def int8(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artifact with two schedules, and their record in fp32."""
    directory = tmp_path_factory.mktemp("int8") / "compiled"
    ttscompile.compile_denoiser(policy.Network().eval(), policy.spec(), directory, precision="int8")
    plans = {"schedule": policy.sparse(), "other": policy.other()}
    store_schedules(directory, None, plans, "schedule", {}, golden=record_plans)
    return directory


def test_plans_are_run_in_fp32_and_in_int8(int8: Path) -> None:
    found = ttscompile.verify(int8)
    exact, own = found.rung("plans"), found.rung(RUNG)
    assert (exact.status, own.status) == (PASSED, PASSED)
    assert exact.figure is not None and own.figure is not None and own.tolerance is not None
    assert exact.figure < PROMISED < own.figure < own.tolerance, "int8 differs from fp32, and is what ran"
    assert set(own.details["errors"]) == {"schedule", "other"}


def test_other_samples_and_other_cells_than_recorded_fail(int8: Path) -> None:
    artifact = load_artifact(int8)
    golden, runtime = load_golden(artifact), open_runtime(artifact)
    recorded = load_golden_plans(artifact, golden.streams)

    def check(**changed: GoldenPlan) -> Rung:
        rung = check_plans_precision(artifact, golden, {**recorded, **changed}, runtime)
        assert rung is not None
        return rung

    assert check().status == PASSED
    moved = replace(recorded["other"], sample=recorded["other"].sample + 1)
    rung = check(other=moved)
    assert rung.status == FAILED
    assert "the samples of 'other'" in rung.told
    assert "schedule" not in rung.told
    cells = recorded["schedule"].plan.copy()
    cells[:, :, 5, 1] = Source.COMPUTE
    rung = check(schedule=replace(recorded["schedule"], plan=cells))
    assert rung.status == FAILED
    assert "'schedule' in 1 of 60 cells" in rung.told
    assert "precision='fp32'" in rung.remedy
