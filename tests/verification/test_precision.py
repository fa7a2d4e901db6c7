"""Plans of an artifact with int8 blocks are verified as ``load`` runs them, not in fp32 alone."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import ttscompile
from tests.plans import store_schedules
from tests.rounding import PROMISED
from ttscompile.artifact import codec, tensors
from ttscompile.artifact.files import describe
from ttscompile.artifact.golden import GoldenPlan, load_golden, load_golden_plans
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import MANIFEST
from ttscompile.artifact.write import finished
from ttscompile.core.lattice import Source
from ttscompile.lower.precision import quantize_matrix
from ttscompile.runtimes import open_runtime
from ttscompile.verification.precision import EIGHT_BITS, FOUR_BITS, HALF, _off, check_plans_precision, check_precision
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


@pytest.mark.slow
def test_plans_are_run_in_fp32_and_in_int8(int8: Path) -> None:
    found = ttscompile.verify(int8)
    exact, own = found.rung("plans"), found.rung(RUNG)
    assert (exact.status, own.status) == (PASSED, PASSED)
    assert exact.figure is not None and own.figure is not None and own.tolerance is not None
    assert exact.figure < PROMISED < own.figure < own.tolerance, "int8 differs from fp32, and is what ran"
    assert set(own.details["errors"]) == {"schedule", "other"}


@pytest.mark.slow
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
    assert "plan.exact" in rung.remedy


def changed(directory: Path, change: Callable[[dict[str, Any]], None]) -> Rung:
    """The rung of an artifact whose integers are others, though hashes say that it is whole."""
    manifest = codec.decode((directory / MANIFEST).read_bytes())
    assert manifest.precision is not None
    path = directory / manifest.precision.weights
    arrays = {name: np.array(array) for name, array in tensors.read(path).items()}
    change(arrays)
    path.write_bytes(tensors.serialize(arrays))
    manifest = replace(manifest, files={**manifest.files, path.name: describe(path)})
    (directory / MANIFEST).write_bytes(finished(manifest)[1])
    artifact = load_artifact(directory)
    rung = check_precision(artifact, load_golden(artifact), open_runtime(artifact))
    assert rung is not None
    return rung


@pytest.mark.slow
def test_integers_are_the_weights_rounded(int8: Path, tmp_path: Path) -> None:
    """A scale that is a twentieth too large moves the largest of its column by six steps, and a call by little."""

    def larger(arrays: dict[str, Any]) -> None:
        name = next(name for name in arrays if name.endswith(".scale"))
        arrays[name][0] *= np.float32(1.05)

    rung = changed(Path(shutil.copytree(int8, tmp_path / "same")), lambda arrays: None)
    assert (rung.status, rung.tolerance) == (PASSED, EIGHT_BITS)
    assert rung.figure is not None and 1e-5 < rung.figure < EIGHT_BITS
    rung = changed(Path(shutil.copytree(int8, tmp_path / "larger")), larger)
    assert rung.status == FAILED and rung.figure == pytest.approx(127 * 0.05 / 1.05, abs=0.01)
    assert "of their steps off; rounded weights are half of one" in rung.told


@pytest.mark.slow
def test_integers_in_another_order_make_another_call(int8: Path, tmp_path: Path) -> None:
    def turned(arrays: dict[str, Any]) -> None:
        for name, array in arrays.items():
            if array.dtype == np.int8:
                arrays[name] = array[::-1].copy()

    rung = changed(Path(shutil.copytree(int8, tmp_path / "turned")), turned)
    assert rung.status == FAILED and rung.figure is not None and rung.figure > EIGHT_BITS
    assert rung.told.startswith("a dense call with int8 in blocks")


@pytest.mark.slow
@pytest.mark.parametrize(("share", "numbers", "status"), [(0.15, 1, PASSED), (0.15, None, FAILED), (np.nan, 1, FAILED)])
def test_one_number_may_be_far_off_and_not_all(
    int8: Path, share: float, numbers: int | None, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a policy has two ways to act, rounding chooses between them."""
    artifact = load_artifact(int8)
    golden, runtime = load_golden(artifact), open_runtime(artifact)
    predict = runtime.predict

    def off(obs: Any, noise: Any, plan: Any) -> Any:
        sample, report = predict(obs, noise, replace(plan, precision={}))
        wrong = sample.reshape(-1).copy()
        wrong[np.argsort(np.abs(wrong))[-(numbers or wrong.size) :]] *= 1 + share  # the largest ones
        return wrong.reshape(sample.shape), report

    monkeypatch.setattr(runtime, "predict", off)
    rung = check_precision(artifact, golden, runtime)
    assert rung is not None and rung.status == status
    assert rung.unit == "of the sample's norm"


@given(st.integers(0, 2**32 - 1))
def test_rounding_is_half_a_step_wherever_the_columns_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((36, 6)).astype(np.float32) * rng.uniform(0.1, 10, 6).astype(np.float32)
    integers, scale = quantize_matrix(matrix)
    of_convolution = matrix.reshape(3, 3, 4, 6).transpose(3, 2, 0, 1)
    ways = (matrix, np.ascontiguousarray(matrix.T), of_convolution, matrix.reshape(4, 9, 2, 3))
    assert all(_off(integers, scale, weight) <= HALF for weight in ways)
    integers[:, rng.integers(6)] //= 2
    assert all(_off(integers, scale, weight) > HALF for weight in ways)


@pytest.mark.slow
def test_four_bits_have_a_tolerance_of_their_own(tmp_path: Path) -> None:
    """A scale that is a twentieth too large is further off than plain rounding."""
    directory = tmp_path / "int4"
    ttscompile.compile_denoiser(policy.Network().eval(), policy.spec(), directory, precision="int4")
    rung = ttscompile.verify(directory).rung("precision")
    assert (rung.status, rung.tolerance) == (PASSED, FOUR_BITS)
    assert rung.figure is not None and EIGHT_BITS / 10 < rung.figure < FOUR_BITS
    assert rung.told.startswith("a dense call with int4 in blocks")

    def larger(arrays: dict[str, Any]) -> None:
        name = next(name for name in arrays if name.endswith(".int4.scale"))
        arrays[name] *= np.float32(1.2)

    rung = changed(Path(shutil.copytree(directory, tmp_path / "larger")), larger)
    assert rung.status == FAILED and rung.unit == "of a step"


def test_a_constant_without_such_columns_is_far_off() -> None:
    integers, scale = quantize_matrix(np.ones((5, 7), np.float32))
    assert _off(integers, scale, np.ones((35, 1, 1), np.float32)) == np.inf
