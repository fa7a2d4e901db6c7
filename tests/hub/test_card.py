"""The card of an artifact: what it says, and what it keeps to itself."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.cli import main
from ttscompile.core.spec import Instruction
from ttscompile.errors import ReportError
from ttscompile.report.push import card


@pytest.mark.slow
def test_a_card_says_what_the_policy_needs_and_nothing_of_your_machine(toy_artifact: Path) -> None:
    """Of real time only who measures can tell; of text only a policy that is told its task needs a tokenizer."""
    made = load_artifact(toy_artifact)
    key = next(iter(made.manifest.spec.observations))
    told = replace(made.manifest.spec, instruction=Instruction(key, key, False))
    text, of_words = (
        card(replace(made, manifest=replace(made.manifest, spec=each)), "org/name", [], [], None)
        for each in (made.manifest.spec, told)
    )
    assert "it runs with numpy and onnxruntime alone" in text and "real time" not in text
    assert "tokenizer" not in text and "give `load` its folder, `tokenizer=DIR`" in of_words
    stores = replace(made.manifest.stores, tokenizer="tokenizer.json")
    with_it = card(replace(made, manifest=replace(made.manifest, spec=told, stores=stores)), "org/name", [], [], None)
    assert "the text `task`, which takes the package `tokenizers`." in with_it and "tokenizer=DIR" not in with_it


@pytest.mark.parametrize(
    ("record", "told"),
    [
        ({"learned": ["schedule"], "seed": 3}, "--seed 3`"),
        ({"learned": ["bac", "weights"], "seed": 3}, "--seed 3 --learn bac,weights`"),
        ({"strategy": "tts", "learned": ["schedule"], "seed": 3}, "--seed 3`"),
        ({"strategy": "tts", "learned": ["schedule", "weights"], "seed": 3}, "--seed 3 --learn schedule,weights`"),
        ({"strategy": "bac", "learned": ["schedule"], "seed": 3}, "--seed 3 --learn bac`"),
        ({"strategy": "bac", "seed": 3}, "--seed 3 --learn bac`"),
        ({"strategy": "tts", "learned": ["loops", "tokens"], "seed": 3}, "--seed 3 --learn loops,tokens`"),
    ],
)
def test_a_card_shows_the_command_of_now_for_records_of_before(
    toy_artifact: Path, record: dict[str, Any], told: str
) -> None:
    made = load_artifact(toy_artifact)
    known = replace(made, manifest=replace(made.manifest, calibration=record))
    assert f"`ttscompile calibrate DIR --trajectories CALLS {told}" in card(known, "org/name", [], [], None)


@pytest.mark.slow
def test_a_card_of_a_calibrated_artifact_has_its_figures(
    toy_artifact: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibrated = tmp_path / "calibrated"
    shutil.copytree(toy_artifact, calibrated)
    obs = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 2)).astype(np.float32)
    np.savez(tmp_path / "calls.npz", obs=obs, episode_ends=[10, 20, 30, 40])
    ttscompile.calibrate(calibrated, [tmp_path / "calls.npz"], target_sparsity=0.5, learn=("interval",))
    identity = load_artifact(calibrated).manifest.identity
    figure = {"mean": 0.75, "low": 0.5, "high": 1.0}
    variant = {"identity": identity, "label": "/home/me/calibrated:x|y", "success": figure, "score": figure}
    document: dict[str, Any] = {
        "environment": "pusht",
        "machine": {
            "processor": "a <b>processor</b>",
            "instructions": [],
            "cores": 1,
            "load_average": 0,
            "memory_gib": 1,
            "system": "Linux",
        },
        "variants": [{**variant, "episodes": [{}] * 8}, {**variant, "identity": "0" * 64, "episodes": []}],
    }
    (tmp_path / "success.json").write_text(json.dumps(document))
    words = ["push", str(calibrated), "org/name", "--dry-run", "--evaluation"]
    result = CliRunner().invoke(main, [*words, str(tmp_path / "success.json")])
    assert result.exit_code == 0, result.output
    record = load_artifact(calibrated).manifest.calibration
    assert record is not None
    plan = load_artifact(calibrated).manifest.default_plan
    for told in (
        f"{record['plans'][plan]['error']:.4g}",
        "| pusht | calibrated:x\\|y | 8 | 0.750 \\[0.500, 1.000\\] | 0.750 \\[0.500, 1.000\\] |",
        "a \\<b\\>processor\\</b\\>",
        "--target-sparsity 0.5 --seed 0 --learn interval`",
        f"| identity | {identity} |",
        "licence | not known: ask who trained the base",
        'policy = ttscompile.load("hf://org/name", threads=1)',
    ):
        assert told in result.stdout, result.stdout
    assert "/home/me" not in result.stdout and str(tmp_path) not in result.stdout
    for bad, why in (
        (b"{", "expected what examples/evaluation/evaluate.py --json printed"),
        (json.dumps({**document, "variants": document["variants"][1:]}).encode(), "no variant in it has the identity"),
        (json.dumps({**document, "variants": [variant]}).encode(), "found KeyError"),
    ):
        (tmp_path / "bad.json").write_bytes(bad)
        with pytest.raises(ReportError, match=why):
            ttscompile.push(calibrated, "org/name", evaluations=[tmp_path / "bad.json"], dry_run=True, runs=1)
