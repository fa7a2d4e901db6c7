"""Policies whose blocks have eight-bit weights: against fp32 and the reference, and on processors that saturate."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.calibration import policies
from tests.once import Once
from ttscompile import Noise, TtscompileError
from ttscompile.artifact import load_artifact
from ttscompile.errors import ArtifactError, RuntimeUnavailableError
from ttscompile.runtimes import against_fp32, open_runtime
from ttscompile.runtimes.onnxruntime import sessions
from ttscompile.runtimes.random_calls import random_calls

from .agreement import largest_difference, random_inputs


@pytest.fixture
def int8(once: Once) -> Path:
    """A small nonlinear policy with a stochastic sampler."""
    return policies.compiled(once, "int8")


@pytest.fixture
def fp32(once: Once) -> Path:
    """The same in fp32."""
    return policies.compiled(once)


@pytest.mark.slow
def test_it_is_the_reference_within_its_own_tolerance_on_random_plans(int8: Path) -> None:
    """Plans of all sources over episodes of three calls; the reference computes in fp32."""
    artifact = load_artifact(int8)
    record = artifact.manifest.precision
    assert record is not None and record.error is not None
    assert 0 < record.error.tolerance < 0.2
    assert 0 < record.error.mean <= record.error.p90 <= record.error.largest
    compiled, reference = open_runtime(artifact), open_runtime(artifact, "reference")
    for seed in range(6):
        found = largest_difference(artifact, compiled, reference, np.random.default_rng(seed), 1 + seed % 3, calls=3)
        assert 1e-5 < found < record.error.tolerance, "not in eight bits, or further off than the artifact says"


def test_the_measured_error_is_what_the_public_interface_gives(int8: Path) -> None:
    record = load_artifact(int8).manifest.precision
    assert record is not None and record.error is not None
    policies_ = [ttscompile.load(int8), ttscompile.load(int8, precision="fp32")]
    assert [one.info.precision for one in policies_] == ["int8", "fp32"]
    errors = []
    for obs, noise in random_calls(policies.spec(), record.error.calls, against_fp32.SEED):
        actions = []
        for policy in policies_:
            policy.reset()
            actions.append(policy.predict_action(obs, noise=noise, plan="dense")["action"])
        errors.append(np.abs(actions[0] - actions[1]))
    assert record.error.mean == pytest.approx(np.mean(errors), rel=0.05)
    assert record.error.largest == pytest.approx(np.max(errors), rel=0.05)


@pytest.mark.slow
def test_fp32_of_an_int8_artifact_is_the_fp32_artifact(int8: Path, fp32: Path) -> None:
    with_both, plain = load_artifact(int8).at_precision("fp32"), load_artifact(fp32)
    obs, noise = random_inputs(plain, np.random.default_rng(0), 2)
    plan = plain.schedule("dense")
    samples = [open_runtime(one).predict(obs, noise, plan)[0] for one in (with_both, plain)]
    np.testing.assert_array_equal(*samples)
    assert not np.array_equal(open_runtime(load_artifact(int8)).predict(obs, noise, plan)[0], samples[0])


def test_the_reference_runtime_computes_in_fp32(int8: Path) -> None:
    assert ttscompile.load(int8, "reference").info.precision == "fp32"
    with pytest.raises(RuntimeUnavailableError, match="'reference' computes in 'fp32' alone; found precision 'int8'"):
        ttscompile.load(int8, "reference", precision="int8")
    with pytest.raises(ArtifactError, match="'bf16': expected one that the artifact holds"):
        ttscompile.load(int8, precision="bf16")


def test_calls_repeat_to_the_bit(int8: Path) -> None:
    artifact = load_artifact(int8)
    digests = set()
    for threads in (1, 1, 2):
        runtime = open_runtime(artifact, threads=threads)
        obs, noise = random_inputs(artifact, np.random.default_rng(3), 2)
        for _ in range(2):
            runtime.reset()
            sample = runtime.predict(obs, noise, artifact.schedule("dense"))[0]
            digests.add(hashlib.sha256(sample.tobytes()).hexdigest())
    assert len(digests) == 1


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("found", "told"), [(False, "found one without them"), (None, "found nothing that says")])
def test_where_sums_saturate_they_are_made_exact_and_a_warning_says_that_it_is_slow(
    int8: Path, found: bool | None, told: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    artifact = load_artifact(int8)
    obs, noise = random_inputs(artifact, np.random.default_rng(3), 1)
    expected = open_runtime(artifact).predict(obs, noise, artifact.schedule("dense"))[0]
    monkeypatch.setattr(sessions, "has_integer_dot_product", lambda: found)
    with pytest.warns(RuntimeWarning, match=rf"avx512_vnni.*{told}.*precision='fp32'"):
        careful = open_runtime(artifact, threads=threads)
    np.testing.assert_allclose(careful.predict(obs, noise, artifact.schedule("dense"))[0], expected, rtol=1e-5)
    open_runtime(artifact.at_precision("fp32"))  # no warning, which would be an error here


def test_a_policy_that_gives_no_numbers_is_not_measured(int8: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    artifact = load_artifact(int8)
    broken = {"obs": np.full((1, 2, 3), np.nan, np.float32)}
    noise = Noise(np.zeros((1, 8, 2), np.float32), np.zeros((10, 1, 8, 2), np.float32))
    runtimes = [open_runtime(one) for one in (artifact, artifact.at_precision("fp32"))]
    own, exact = (against_fp32.answers(one, artifact.schedule("dense"), [(broken, noise)]) for one in runtimes)
    with pytest.raises(TtscompileError, match="not a number"):
        against_fp32.mean_errors(policies.spec().chunk, own, exact)


def test_nothing_to_lower_and_unknown_precisions_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    module, spec = policies.Mixer(0).eval(), policies.spec()
    for name in ("bf16", "int4", "FP32"):
        with pytest.raises(TtscompileError, match=f"precision '{name}'"):
            ttscompile.compile_denoiser(module, spec, tmp_path / "compiled", precision=name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_converting_again_gives_the_same_bytes_measured_error_and_all(int8: Path, tmp_path: Path) -> None:
    ttscompile.compile_denoiser(policies.Mixer(0).eval(), policies.spec(), tmp_path / "again", precision="int8")
    assert {p.name: p.read_bytes() for p in (tmp_path / "again").iterdir()} == {
        p.name: p.read_bytes() for p in int8.iterdir()
    }
