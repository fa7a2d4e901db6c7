"""An artifact of the schema before the present one, as it was written then: it is read, and does what it did.

``schema11/artifact.zip`` was made with the last ttscompile that wrote schema 11: a small policy of five steps with two
cameras and an instruction, two loops and two that begin with the chunk before, eight bits, schedules, one of them
corrected, pruners, weights that were trained, and reused tokens. ``schema11/answers.npz`` has what that ttscompile
answered to two calls of an episode, by plan: in fp32 with all tokens, and in the precision of its own. Neither is ever
made anew: when schema 13 comes, a file of schema 12 takes its place.
"""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.artifact.folders import contents
from ttscompile import Noise
from ttscompile.artifact import load_artifact
from ttscompile.artifact.codec import _checksum
from ttscompile.artifact.manifest import SCHEMA_VERSION
from ttscompile.artifact.write import update_plans
from ttscompile.errors import ArtifactError

HERE = Path(__file__).with_name("schema11")
PLANS = ("full", "schedule", "mixed", "tokens", "pruner", "four", "trained", "original-last-2", "euler-4-last-3")


@pytest.fixture
def old(tmp_path: Path) -> Path:
    with zipfile.ZipFile(HERE / "artifact.zip") as packed:
        packed.extractall(tmp_path / "old")
    return tmp_path / "old"


def edited(path: Path, change: Any) -> Path:
    """The artifact with a changed manifest, whose checksum is right."""
    document = json.loads((path / "manifest.json").read_bytes())
    del document["checksum"]
    change(document)
    (path / "manifest.json").write_text(json.dumps({**document, "checksum": _checksum(document)}))
    return path


def test_it_is_the_schema_before() -> None:
    with zipfile.ZipFile(HERE / "artifact.zip") as packed:
        assert json.loads(packed.read("manifest.json"))["schema_version"] == SCHEMA_VERSION - 1


@pytest.mark.parametrize("precision", ["own", "fp32"])
def test_its_plans_give_the_actions_that_they_gave(old: Path, precision: str) -> None:
    answers = np.load(HERE / "answers.npz")
    keys = [key.removeprefix("obs/0/") for key in answers if key.startswith("obs/0/")]
    policy, noise = ttscompile.load(old), Noise(answers["initial"])
    assert set(policy.plans) == {"dense", *PLANS}
    for name in ("dense", *PLANS):
        policy.reset()
        for call in range(2):
            obs = {key: answers[f"obs/{call}/{key}"] for key in keys}
            found = policy.predict_action(obs, noise=noise, plan=f"{name}@fp32" if precision == "fp32" else name)
            expected = answers[f"{precision}/{name}/{call}"]
            # Eight bits are rounded otherwise on a processor without their instructions.
            atol = np.abs(expected).max() * (1e-5 if precision == "fp32" else 0.05)
            np.testing.assert_allclose(found["action_pred"], expected, rtol=0, atol=atol, err_msg=f"{name} {call}")


def test_it_verifies_and_can_be_changed(old: Path) -> None:
    before = load_artifact(old)
    found = {rung.name: rung.status for rung in ttscompile.verify(old).rungs}
    assert "failed" not in {status for name, status in found.items() if name != "engaged"}, found
    kept = ("dense", "schedule", "trained")
    manifest = update_plans(old, {name: before.plans[name] for name in kept}, "trained")
    assert (before.manifest.schema_version, manifest.schema_version) == (SCHEMA_VERSION, SCHEMA_VERSION)
    assert json.loads((old / "manifest.json").read_bytes())["schema_version"] == SCHEMA_VERSION
    again = load_artifact(old).manifest
    assert (again.identity, set(again.plans), again.starts) == (manifest.identity, {"schedule", "trained"}, {})
    assert again.model_identity == before.manifest.model_identity
    assert set(contents(old)) == {"manifest.json", *again.files}


def test_its_identities_are_held_against_what_it_computes(old: Path) -> None:
    with pytest.raises(ArtifactError, match="expected the identity"):
        load_artifact(edited(old, lambda d: d.update(default_plan="mixed")))


@pytest.mark.parametrize("schema", [9, 10, SCHEMA_VERSION + 1, True, "11"])
def test_older_and_newer_ones_are_refused(old: Path, schema: Any) -> None:
    with pytest.raises(ArtifactError, match="expected 12 or the one before"):
        load_artifact(edited(old, lambda d: d.update(schema_version=schema)))


@pytest.mark.parametrize("member", ["starts", "weights", "plans", "precision", "default_plan"])
def test_what_lacks_a_part_is_refused(old: Path, member: str) -> None:
    with pytest.raises(ArtifactError, match=f"expected .*{member}"):
        load_artifact(edited(old, lambda d: d.pop(member)))
