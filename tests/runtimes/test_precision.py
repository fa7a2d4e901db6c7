"""Policies whose blocks have eight-bit weights: against fp32 and the reference, and on processors that saturate."""

from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.calibration import policies
from tests.once import Once
from ttscompile import TtscompileError
from ttscompile.artifact import load_artifact
from ttscompile.errors import ArtifactError, IllegalPlanError, RuntimeUnavailableError
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.onnxruntime import sessions
from ttscompile.verification.precision import CARRIED, EIGHT_BITS

from .agreement import largest_difference, random_inputs


@pytest.fixture
def int8(once: Once) -> Path:
    """A small nonlinear policy with a stochastic sampler."""
    return policies.compiled(once, "int8")


@pytest.fixture
def fp32(once: Once) -> Path:
    """The same in fp32."""
    return policies.compiled(once)


def test_it_is_the_reference_within_the_tolerance_of_eight_bits_on_random_plans(int8: Path) -> None:
    """Plans of all sources over episodes of three calls; the reference computes in fp32."""
    artifact = load_artifact(int8)
    own = artifact.plan("dense@int8")
    compiled, reference = open_runtime(artifact), open_runtime(artifact, "reference", plan=own.exact)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        found = largest_difference(artifact, compiled, reference, rng, 1 + seed % 3, calls=3, base=own)
        assert 1e-5 < found < CARRIED * EIGHT_BITS, "not in eight bits, or further off than verify allows"


@pytest.mark.slow
def test_fp32_of_an_int8_artifact_is_the_fp32_artifact(int8: Path, fp32: Path) -> None:
    with_both, plain = load_artifact(int8), load_artifact(fp32)
    obs, noise = random_inputs(plain, np.random.default_rng(0), 2)
    samples = [open_runtime(one).predict(obs, noise, one.plans["dense"])[0] for one in (with_both, plain)]
    np.testing.assert_array_equal(samples[0], samples[1])
    assert not np.array_equal(open_runtime(with_both).predict(obs, noise, with_both.plans["full"])[0], samples[0])


def test_the_reference_runtime_computes_in_fp32(int8: Path) -> None:
    assert ttscompile.load(int8, "reference", plan="full@fp32").info.precision == "fp32"
    with pytest.raises(
        RuntimeUnavailableError, match="'reference' computes in fp32 alone; the plan wants 'blocks' in 'int8'"
    ):
        ttscompile.load(int8, "reference")
    with pytest.raises(RuntimeUnavailableError, match="'onnxruntime' computes in fp32, and beside it int8"):
        ttscompile.load(int8, plan="full@bf16")


def test_parts_may_be_named_one_by_one(int8: Path) -> None:
    artifact = load_artifact(int8)
    record = artifact.manifest.precision
    assert record is not None
    parts = record.kept
    assert artifact.plan(f"dense@int8+{'+'.join(parts)}").precision == artifact.plan("dense@int8").precision
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 1)
    found = [open_runtime(artifact).predict(obs, noise, artifact.plan(f"dense@int8+{part}"))[0] for part in parts]
    found.append(open_runtime(artifact).predict(obs, noise, artifact.plans["dense"])[0])
    for i, one in enumerate(found):
        assert all(not np.array_equal(one, other) for other in found[:i])
    with pytest.raises(ArtifactError, match="wants 'nonsense' in 'int8'"):
        ttscompile.load(int8, plan="dense@int8+nonsense")
    for wrong in ("dense@fp32+blocks", "dense@+blocks", "dense@", "dense@int8+"):
        with pytest.raises(IllegalPlanError, match="has no plan"):
            artifact.plan(wrong)


def test_a_precision_that_the_artifact_does_not_hold_is_refused_by_its_name(fp32: Path) -> None:
    with pytest.raises(ArtifactError, match="a plan wants 'blocks' in 'int8'; the artifact has fp32 alone"):
        ttscompile.load(fp32, plan="dense@int8")


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("found", "told"), [(False, "found one without them"), (None, "found nothing that says")])
def test_where_sums_saturate_they_are_made_exact_and_a_warning_says_that_it_is_slow(
    int8: Path, found: bool | None, told: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    artifact = load_artifact(int8)
    obs, noise = random_inputs(artifact, np.random.default_rng(3), 1)
    expected = open_runtime(artifact).predict(obs, noise, artifact.plans["full"])[0]
    monkeypatch.setattr(sessions, "has_integer_dot_product", lambda: found)
    with pytest.warns(UserWarning, match=rf"avx512_vnni.*{told}.*NAME@fp32"):
        careful = open_runtime(artifact, threads=threads)
    np.testing.assert_allclose(careful.predict(obs, noise, artifact.plans["full"])[0], expected, rtol=1e-5)
    open_runtime(artifact, plan=artifact.plans["dense"])  # no warning, which would be an error here


def test_nothing_to_lower_and_unknown_precisions_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    module, spec = policies.Mixer(0).eval(), policies.spec()
    for name in ("bf16", "int3", "FP32", "auto"):
        with pytest.raises(TtscompileError, match=f"precision '{name}'"):
            ttscompile.compile_denoiser(module, spec, tmp_path / "compiled", precision=name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_converting_again_gives_the_same_bytes(int8: Path, tmp_path: Path) -> None:
    ttscompile.compile_denoiser(policies.Mixer(0).eval(), policies.spec(), tmp_path / "again", precision="int8")
    assert {p.name: p.read_bytes() for p in (tmp_path / "again").iterdir()} == {
        p.name: p.read_bytes() for p in int8.iterdir()
    }
