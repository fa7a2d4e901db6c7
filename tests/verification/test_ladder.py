"""A sound artifact holds; each way of breaking one fails at its rung, which names step and block."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

import ttscompile
from tests.plans import store_schedules
from tests.rounding import PROMISED
from tests.runtimes.plans import random_correction
from ttscompile import Affine
from ttscompile.artifact import tensors
from ttscompile.artifact.golden import DIGITS, load_golden, load_golden_plans
from ttscompile.artifact.load import load_artifact, read_manifest
from ttscompile.core.correction import Correction, no_correction
from ttscompile.core.lattice import Source
from ttscompile.errors import ArtifactError
from ttscompile.ir.program import Program
from ttscompile.runtimes.contexts import ContextValues
from ttscompile.verification.record_golden import record_original, record_plans
from ttscompile.verification.rung import FAILED, PASSED, SKIPPED, Rung

from . import policy
from .broken import edit_manifest, edited, exchange_names

LADDER = [
    *("integrity", "preprocessing", "block", "evaluation", "dense call", "runtimes", "plans", "distance"),
    "engaged",
]


def failure(artifact: Path, *recordings: Path) -> Rung:
    """The lowest rung that fails; the bytes are sound in all of these tests."""
    found = ttscompile.verify(artifact, recordings, calls=8)
    assert found.rungs[0].status == PASSED, found.rungs[0].told
    assert not found.passed
    assert found.first_failure is not None
    json.dumps(found.to_json(), allow_nan=False)
    return found.first_failure


@pytest.mark.slow
def test_a_sound_artifact_holds(sound: Path) -> None:
    """Whether its plans save time is no matter here, which other work may hide."""
    found = ttscompile.verify(sound)
    assert [rung.name for rung in found.rungs] == LADDER
    assert {rung.name: rung.told for rung in found.rungs[:-1] if rung.status == FAILED} == {}
    assert {rung.name for rung in found.rungs[:-1] if rung.status == SKIPPED} == {"distance"}
    assert all(rung.figure is not None and rung.figure < PROMISED for rung in found.rungs[2:7]), "exports are exact"
    assert found.identity == read_manifest(sound).identity
    assert found.map is not None
    assert found.map.errors.shape == (10, 6)
    json.dumps(found.to_json(), allow_nan=False)


@pytest.mark.slow
def test_an_artifact_that_is_not_calibrated_holds_and_says_what_it_lacks(compiled: Path) -> None:
    found = ttscompile.verify(compiled)
    assert found.passed
    assert all("every call computes all cells" in found.rung(name).told for name in ("plans", "distance"))
    assert "every call is dense" in found.rung("engaged").told


def test_the_weights_of_one_block(artifact: Path) -> None:
    with edited(artifact, "weights") as arrays:
        arrays["narrow.1.weight"][:4] *= 1.02
    rung = failure(artifact)
    assert (rung.name, rung.blocks, rung.step) == ("block", (3,), 0)
    assert "block 3" in rung.told


def test_the_weights_of_two_blocks_exchanged(artifact: Path) -> None:
    with edited(artifact, "weights") as arrays:
        for name in ("narrow.{}.weight", "narrow.{}.bias", "wide.{}.weight", "wide.{}.bias"):
            one, other = name.format(0), name.format(2)
            arrays[one], arrays[other] = arrays[other], arrays[one]
    rung = failure(artifact)
    assert (rung.name, rung.blocks) == ("block", (1, 5))


def test_the_names_of_two_blocks_weights_exchanged(artifact: Path) -> None:
    """The ONNX graphs find their weights by place, the reference runtime by name: so they disagree."""
    exchange_names(artifact, "narrow.0.weight", "narrow.2.weight")
    rung = failure(artifact)
    assert (rung.name, rung.blocks) == ("runtimes", (1, 5))


def test_the_graphs_of_two_blocks_exchanged(artifact: Path) -> None:
    pieces = read_manifest(artifact).pieces
    one, other = pieces["block_01"], pieces["block_05"]
    files = {"block_01": replace(one, file=other.file), "block_05": replace(other, file=one.file)}
    edit_manifest(artifact, pieces={**pieces, **files})
    rung = failure(artifact)
    assert (rung.name, rung.status) == ("block", FAILED)
    assert "do not fit each other" in rung.told, "the inputs of these two graphs have other names"


def test_the_table_of_one_step(artifact: Path) -> None:
    (name,) = (name for name in load_artifact(artifact).tables)
    with edited(artifact, "weights") as arrays:
        arrays[f"table/{name}"][7] += 0.1
    rung = failure(artifact)
    assert (rung.name, rung.step) == ("block", 7)
    assert rung.blocks == (0, 2, 4), "the blocks that see the time"
    assert "All of them read" in rung.told


@pytest.mark.slow
@pytest.mark.parametrize("weight", ["embed.weight", "head.weight"])
def test_what_is_no_block(weight: str, artifact: Path) -> None:
    small = np.array(load_artifact(artifact).weights[weight]).nbytes <= 256
    assert not small, "small weights are kept in the graphs"
    with edited(artifact, "weights") as arrays:
        arrays[weight] *= 1.05
    # The stem and the tail are in the graph of the same name and in that of ``advance``.
    assert failure(artifact).name == "evaluation"


def test_the_normaliser_of_an_observation(artifact: Path) -> None:
    spec = read_manifest(artifact).spec
    old = spec.observations["obs"]
    assert old.normalizer is not None
    turned = Affine(old.normalizer.scale[::-1].copy(), old.normalizer.offset)
    edit_manifest(artifact, spec=replace(spec, observations={"obs": replace(old, normalizer=turned)}))
    rung = failure(artifact)
    assert rung.name == "preprocessing"
    assert rung.details["wrong"] == ["observation 'obs'"]


def test_the_normaliser_of_the_action(artifact: Path) -> None:
    spec = read_manifest(artifact).spec
    old = spec.chunk.normalizer
    assert old is not None
    moved = Affine(old.scale, old.offset + np.float32(0.01))
    edit_manifest(artifact, spec=replace(spec, chunk=replace(spec.chunk, normalizer=moved)))
    rung = failure(artifact)
    assert (rung.name, rung.details["wrong"]) == ("preprocessing", ["the action"])


def test_another_part_of_the_chunk(artifact: Path) -> None:
    spec = read_manifest(artifact).spec
    moved = replace(spec.chunk, start=spec.chunk.start + 1, stop=spec.chunk.stop + 1)
    edit_manifest(artifact, spec=replace(spec, chunk=moved))
    assert failure(artifact).details["wrong"] == ["the executed part of the chunk"]


def test_the_sampler_at_one_step(artifact: Path) -> None:
    spec = read_manifest(artifact).spec
    column = spec.sampler.sample_to_next.copy()
    column[3] *= 1.05
    edit_manifest(artifact, spec=replace(spec, sampler=replace(spec.sampler, sample_to_next=column)))
    rung = failure(artifact)
    assert (rung.name, rung.step) == ("dense call", 3)
    assert "the sampler" in rung.told


class Modulated(policy.Network):
    """Blocks see one value of time and observation both: the step piece makes it."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        told = torch.tanh(self.encode(obs.flatten(1)) + self.time(timestep)).unsqueeze(1)
        h = self.embed(sample)
        for wide, narrow in zip(self.wide, self.narrow, strict=True):
            h = h + narrow(torch.nn.functional.gelu(wide(h + told)))
        return self.head(h)


@pytest.mark.slow
def test_a_runtime_whose_prologue_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pieces are sound, and the runtime mistakes one step for another before the loop."""
    ttscompile.compile_denoiser(Modulated().eval(), policy.spec(), tmp_path / "compiled")
    kept = ContextValues.keep_steps

    def turned(self: ContextValues, made: Iterable[tuple[str, np.ndarray]]) -> None:
        kept(self, [(name, np.roll(value, self.streams, 0)) for name, value in made])

    monkeypatch.setattr(ContextValues, "keep_steps", turned)
    rung = failure(tmp_path / "compiled")
    assert rung.name == "dense call"
    assert "so that the runtime is at fault" in rung.told


@pytest.mark.slow
def test_a_plan_shifted_by_a_step(artifact: Path) -> None:
    with edited(artifact, "plans") as arrays:
        arrays["schedule"] = policy.shifted(arrays["schedule"])
    rung = failure(artifact)
    assert (rung.name, rung.step) == ("plans", 1)
    assert "plan 'schedule'" in rung.told
    assert "first at step 1, block 0: it is the stored plan 1 step later" in rung.told
    errors = ttscompile.verify(artifact).map
    assert errors is not None
    assert errors.plan == "schedule"
    np.testing.assert_array_equal(errors.cells, policy.shifted(policy.sparse()) != policy.sparse())


def test_one_cell_of_a_plan(artifact: Path) -> None:
    with edited(artifact, "plans") as arrays:
        arrays["other"][6, 2] = Source.FORWARD
    rung = failure(artifact)
    assert (rung.name, rung.step, rung.blocks) == ("plans", 6, (2,))
    assert "'other'" in rung.told


def test_two_plans_exchanged(artifact: Path) -> None:
    with edited(artifact, "plans") as arrays:
        arrays["schedule"], arrays["other"] = arrays["other"], arrays["schedule"]
    rung = failure(artifact)
    assert rung.name == "plans"
    assert len(rung.details["failures"]) == 2


def test_a_correction_of_one_step(artifact: Path) -> None:
    with edited(artifact, "plans") as arrays:
        arrays["correction/schedule/weights"][5] += 0.01
    rung = failure(artifact)
    assert (rung.name, rung.step) == ("plans", 5)
    assert "correction" in rung.told


def test_the_pruners_weights(artifact: Path) -> None:
    with edited(artifact, "pruner") as arrays:
        for name, array in arrays.items():
            if array.dtype == np.float32 and name != "pruner.mask":
                arrays[name] = np.random.default_rng(0).standard_normal(array.shape, dtype=np.float32)
    rung = failure(artifact)
    assert rung.name == "plans"
    assert "'pruner'" in rung.told


def _with(artifact: Path, plan: np.ndarray, correction: Correction | None = None) -> Path:
    corrections = {} if correction is None else {"mine": correction}
    store_schedules(artifact, None, {"mine": plan}, "mine", {}, corrections=corrections, golden=record_plans)
    return artifact


def test_a_jump_that_was_changed(artifact: Path) -> None:
    """As it is, the plan holds; with another last layer the sample differs after the step that the jump is added to."""
    correction = random_correction(load_artifact(artifact), np.random.default_rng(0))
    landing = next(iter(correction.landings))
    rungs = ttscompile.verify(_with(artifact, policy.sparse(), correction), calls=8).rungs
    assert [rung.status for rung in rungs if rung.name == "plans"] == [PASSED]
    with edited(artifact, "plans") as arrays:
        arrays["correction/mine/outer"][0] += 0.1
    rung = failure(artifact)
    assert (rung.name, rung.step) == ("plans", landing)


def test_a_plan_that_computes_everything_is_inert(artifact: Path) -> None:
    rung = failure(_with(artifact, np.full((10, 6), Source.COMPUTE, np.int8)))
    assert rung.name == "engaged"
    assert "dense in disguise" in rung.told


def test_a_plan_that_reuses_less_than_it_says_is_inert(artifact: Path) -> None:
    plan = read_manifest(_with(artifact, policy.sparse())).plans["mine"]
    edit_manifest(artifact, plans={"mine": replace(plan, sparsity=0.95)})
    rung = failure(artifact)
    assert rung.name == "engaged"
    assert "was to reuse 95.00%" in rung.told


def test_plans_of_other_means_are_not_verified_and_that_is_said(artifact: Path) -> None:
    store_schedules(artifact, None, {"mine": policy.sparse()}, "mine", {})
    assert read_manifest(artifact).stores.golden_plans is None
    rung = ttscompile.verify(artifact).rung("plans")
    assert rung.status == SKIPPED
    assert "by other means" in rung.told


def test_an_artifact_without_a_record_of_the_original_is_refused(artifact: Path) -> None:
    manifest = read_manifest(artifact)
    stores = manifest.stores
    kept = {name: one for name, one in manifest.files.items() if name not in (stores.golden, stores.golden_plans)}
    edit_manifest(artifact, files=kept, stores=replace(stores, golden=None, golden_plans=None))
    with pytest.raises(ArtifactError, match="expected a golden record"):
        ttscompile.verify(artifact)


def test_a_record_of_another_policy_is_refused(artifact: Path) -> None:
    path = artifact / "golden.safetensors"
    arrays = {name: np.array(array) for name, array in tensors.read(path).items()}
    arrays["residuals"] = arrays["residuals"][:, :5]
    path.write_bytes(tensors.serialize(arrays))
    edit_manifest(artifact)
    with pytest.raises(ArtifactError, match=r"golden record: expected .*'residuals'"):
        ttscompile.verify(artifact)


@pytest.mark.slow
def test_episodes_are_judged_by_their_distance(artifact: Path, recording: Path) -> None:
    found = ttscompile.verify(artifact, [recording], calls=8)
    rung = found.rung("distance")
    assert 8 <= rung.details["calls"] <= 32 and "with 95 % confidence" in rung.told
    assert set(rung.details["plans"]) == {"schedule", "other", "pruner"}
    assert (rung.tolerance, rung.unit) == (1.0, "other noise"), "nothing was promised"
    assert rung.status == PASSED, rung.told

    wrong = no_correction(policy.STEPS, (policy.HORIZON, policy.CHANNELS))
    wrong.bias[-1] += 1
    rung = failure(_with(artifact, policy.sparse(), wrong), recording)
    assert rung.name == "distance"
    assert rung.figure is not None
    assert rung.tolerance is not None
    assert rung.figure > rung.tolerance


@pytest.mark.slow
def test_a_plan_that_is_much_worse_than_calibrated_fails_within_the_noise(artifact: Path, recording: Path) -> None:
    measured = ttscompile.verify(artifact, [recording], calls=8).rung("distance")
    assert measured.figure is not None

    def promised(directory: Path, distance: float) -> Rung:
        edit_manifest(directory, calibration={"plans": {one: {"distance": distance} for one in ("schedule", "mine")}})
        return ttscompile.verify(directory, [recording], calls=8).rung("distance")

    kept = promised(artifact, measured.figure)
    assert (kept.status, kept.details["reasons"]) == (PASSED, []) and "is allowed" not in kept.told
    nearer = promised(artifact, measured.figure / 3)
    assert nearer.status == PASSED and "is allowed, which so few calls do not tell from that" in nearer.told
    worse = no_correction(policy.STEPS, (policy.HORIZON, policy.CHANNELS))
    worse.bias[-1] += 0.4
    broken = promised(_with(artifact, policy.sparse(), worse), measured.figure)
    assert broken.status == FAILED
    assert broken.figure is not None and 2 * measured.figure < broken.figure < 1, "within what other noise changes"
    assert broken.tolerance == pytest.approx(2 * measured.figure)
    assert "worse than calibrated" in broken.told
    assert "more than other noise" not in broken.told


def test_the_record_is_small_and_the_same_every_time(sound: Path, program: Program) -> None:
    content = (sound / "golden.safetensors").read_bytes()
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        again = record_original(policy.Network().eval(), program)
    finally:
        torch.set_num_threads(threads)
    assert tensors.serialize(again.arrays()) == content
    assert len(content) < 20_000
    artifact = load_artifact(sound)
    golden = load_golden(artifact)
    assert golden.residuals.shape == (10, 6, 2, DIGITS)
    first, second = load_golden_plans(artifact, 2)["pruner"].plan
    assert (first[0] != first[1]).any(), "plans of the pruner should depend on the observation"
    np.testing.assert_array_equal(first[0][:1], second[1][:1])


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None
import ttscompile
found = ttscompile.verify(sys.argv[1])
assert found.passed, [rung.told for rung in found.rungs]
heavy = {"onnx", "safetensors", "matplotlib", "diffusers"} & set(sys.modules)
assert not heavy, heavy
rung = found.rung("runtimes")
print(rung.status, rung.told, rung.remedy)
"""


def test_it_needs_no_torch_and_says_what_it_could_not_do(quick: Path) -> None:
    command = [sys.executable, "-W", "error", "-c", WITHOUT_TORCH, str(quick)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("skipped the reference runtime was not run: it needs torch Install 'ttscompile[c")


def test_a_zipped_artifact(quick: Path, tmp_path: Path) -> None:
    archive = shutil.make_archive(str(tmp_path / "zipped"), "zip", quick)
    found = ttscompile.verify(archive)
    assert found.passed, [rung.told for rung in found.rungs]
    assert found.path == archive


def test_a_rung_that_cannot_be_climbed_fails(artifact: Path) -> None:
    path = artifact / "block_02.onnx"
    model = onnx.load(path, load_external_data=False)
    model.graph.node[0].op_type = "NoSuchOperation"
    path.write_bytes(model.SerializeToString())
    edit_manifest(artifact)
    rung = failure(artifact)
    assert (rung.name, rung.status) == ("block", FAILED)
    assert "block_02.onnx" in rung.told
