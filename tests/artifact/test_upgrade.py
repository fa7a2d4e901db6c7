"""An artifact of the schema before the present one, as it was written then: it is read, and does what it did.

``schema10/artifact.zip`` was made with the last ttscompile that wrote schema 10: a small policy of eight steps with
blocks in eight bits, two schedules, one of them corrected, a pruner, weights that were distilled, and a warm start that
was settled. ``schema10/answers.npz`` has what that ttscompile answered, by precision, plan and call. Neither is ever
made anew: when schema 12 comes, a file of schema 11 takes its place.
"""

import json
import shutil
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
from ttscompile.artifact.manifest import SCHEMA_VERSION, StartRecord
from ttscompile.artifact.upgrade import upgraded
from ttscompile.artifact.write import update_plans
from ttscompile.errors import ArtifactError

HERE = Path(__file__).with_name("schema10")
PLANS = ("schedule", "mixed", "distilled", "pruner")


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


@pytest.mark.parametrize("precision", ["int8", "fp32"])
def test_its_plans_give_the_actions_that_they_gave(old: Path, precision: str) -> None:
    answers = np.load(HERE / "answers.npz")
    obs = {key.removeprefix("obs/"): answers[key] for key in answers if key.startswith("obs/")}
    policy, noise = ttscompile.load(old), Noise(answers["initial"])
    assert set(policy.plans) == {"dense", "full", "warm", *PLANS}
    for name in ("dense", *PLANS, "warm"):
        asked = "full" if name == "dense" else name  # what was called dense had the artifact's precision
        policy.reset()
        for call in range(3 if name == "warm" else 2):
            found = policy.predict_action(obs, noise=noise, plan=f"{asked}@fp32" if precision == "fp32" else asked)
            expected = answers[f"{precision}/{name}/{call}"]
            scale = np.abs(expected).max()
            # Eight bits are rounded otherwise on a processor without their instructions.
            atol = scale * (1e-5 if precision == "fp32" else 0.05)
            np.testing.assert_allclose(found["action_pred"], expected, rtol=0, atol=atol, err_msg=f"{name} {call}")


def test_what_it_says_is_said_in_the_words_of_today(old: Path) -> None:
    artifact = load_artifact(old)
    manifest = artifact.manifest
    assert manifest.default_plan == "schedule"
    assert all(plan.precision == {"blocks": "int8"} for name, plan in manifest.plans.items())
    assert {name: plan.weights for name, plan in manifest.plans.items() if plan.weights != "original"} == {
        "distilled": "distilled"
    }
    assert manifest.starts == {"original-last-3": StartRecord("original", 3)}
    assert (manifest.plans["warm"].loop, manifest.plans["warm"].otherwise) == ("original-last-3", "schedule")
    assert artifact.plans["dense"].exact is artifact.plans["dense"]


def test_it_verifies_and_can_be_changed(old: Path) -> None:
    found = {rung.name: rung.status for rung in ttscompile.verify(old).rungs}
    assert "failed" not in {status for name, status in found.items() if name != "engaged"}, found
    plans = {
        name: plan for name, plan in load_artifact(old).plans.items() if name in ("dense", "schedule", "distilled")
    }
    manifest = update_plans(old, plans, "distilled")
    assert manifest.schema_version == SCHEMA_VERSION
    again = load_artifact(old).manifest
    assert (again.identity, set(again.plans), again.starts) == (manifest.identity, {"schedule", "distilled"}, {})
    assert set(contents(old)) == {"manifest.json", *again.files}


def test_the_identities_are_those_of_what_it_computes(old: Path, tmp_path: Path) -> None:
    shutil.copytree(old, tmp_path / "other")
    before = load_artifact(old).manifest
    other = load_artifact(edited(tmp_path / "other", lambda d: d.update(default_plan="mixed"))).manifest
    assert other.model_identity == before.model_identity
    assert other.identity != before.identity


@pytest.mark.parametrize("schema", [8, 9, SCHEMA_VERSION + 1, True, "10"])
def test_older_and_newer_ones_are_refused(old: Path, schema: Any) -> None:
    with pytest.raises(ArtifactError, match="expected 11 or the one before"):
        load_artifact(edited(old, lambda d: d.update(schema_version=schema)))


@pytest.mark.parametrize("member", ["reuse", "warm", "distilled", "plans", "precision", "default_plan"])
def test_what_lacks_a_part_is_refused(old: Path, member: str) -> None:
    with pytest.raises(ArtifactError, match=r"not the manifest of an artifact of schema 10"):
        load_artifact(edited(old, lambda d: d.pop(member)))


def test_tokens_that_were_reused_are_a_field_of_every_plan(old: Path) -> None:
    document = json.loads((old / "manifest.json").read_bytes())
    document["reuse"] = {"threshold": 0.5, "refresh": 8, "computed": 0.1, "error": 0.0, "other_noise": 1.0, "calls": 9}
    new = upgraded(document, "here")
    assert all(plan["tokens"] == {"threshold": 0.5, "refresh": 8} for plan in new["plans"].values())
    assert not {"reuse", "warm", "distilled"} & set(new)
