"""What the compiler, the steps that are left out and the eight bits are worth, each apart."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from factors import main, rows

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import uniform_plan
from ttscompile.report.timing import Measurement


def test_each_row_is_held_against_the_one_before_and_the_first() -> None:
    measured = [Measurement(name, "dense", (ms, ms, 100 * ms)) for name, ms in (("a", 8.0), ("b", 4.0), ("c", 1.0))]
    found = rows(measured, ["a", "b", "c", "of eight bits"])
    assert [(one["ms"], one["than_before"], one["than_first"]) for one in found] == [(8, 1, 1), (4, 2, 2), (1, 4, 8)]


@pytest.mark.slow
def test_the_original_torch_compile_and_the_plans_take_turns(whole_layer_checkpoint: Path, tmp_path: Path) -> None:
    folder = tmp_path / "compiled"
    ttscompile.convert(whole_layer_checkpoint, folder, precision="int8")
    artifact = load_artifact(folder)
    cells = uniform_plan(100, len(artifact.manifest.blocks), full_steps=2)
    plan = replace(artifact.plan("dense"), cells=cells, precision={"blocks": "int8"})
    update_plans(folder, {"schedule": plan}, "schedule")
    words = [str(folder), "--checkpoint", str(whole_layer_checkpoint), "--calls", "1"]
    told = json.loads(CliRunner().invoke(main, [*words, "--json"], catch_exceptions=False).stdout)
    names = [one["what"] for one in told["rows"]]
    assert names[0] == "eager PyTorch" and names[-3:] == [
        "compiled, all computed, fp32",
        "2 of 100 steps of original",
        "2 of 100 steps of original, int8 in blocks",
    ]
    assert all(one["ms"] > 0 for one in told["rows"])
    printed = CliRunner().invoke(main, words, catch_exceptions=False).stdout
    assert "than PyTorch" in printed and "Medians of 1 calls, one thread." in printed
