"""Authors' code beside the same cells compiled: stand-ins draw noise and answer as Diffusion Policy's code does.

``tests/rivals/golden/make_caching.py`` runs the code itself.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import caching_beside
import numpy as np
import pytest
import torch
from click.testing import CliRunner

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.lattice import PlanArray, Source, uniform_plan
from ttscompile.core.plan import DENSE
from ttscompile.core.spec import Noise
from ttscompile.errors import IllegalPlanError
from ttscompile.runtimes.load import open_policy


class Stand:
    """A policy of torch that is the compiled one with some cells, and the noise that torch's generator draws."""

    def __init__(self, path: Path, cells: PlanArray | None) -> None:
        artifact = load_artifact(path)
        self.horizon, self.action_dim = artifact.manifest.spec.sample
        self.num_inference_steps, self._cells = artifact.manifest.steps, cells
        self._policy = open_policy(artifact, plan=DENSE)
        self.model = SimpleNamespace(decoder=SimpleNamespace(layers=[None]))
        if cells is not None:
            computed = [np.flatnonzero(row == Source.COMPUTE).tolist() for row in cells.T]
            names = [f"decoder.layers.0_{name}" for name in caching_beside.PARTS]
            self._cache = {"block_steps": dict(zip(names, computed, strict=True))}

    def predict_action(self, obs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        given = {key: value.numpy() for key, value in obs.items()}
        shape = (len(next(iter(given.values()))), self.horizon, self.action_dim)
        draws = [torch.randn(shape) for _ in range(self.num_inference_steps)]
        steps = torch.stack([*draws[1:], torch.zeros(shape)])
        self._policy.reset()
        noise, plan = Noise(draws[0].numpy(), steps.numpy()), DENSE if self._cells is None else self._cells
        found = self._policy.predict_action(given, noise=noise, plan=plan)["action_pred"]
        return {"action_pred": torch.from_numpy(np.asarray(found))}


def test_both_answer_with_the_same_noise_and_all_is_told(
    compiled_layer: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, cells = 100, uniform_plan(100, 3, 10)
    cells[4, 1] = Source.COMPUTE
    last = cells.copy()
    last[-1] = Source.COMPUTE  # as their code does
    artifact = tmp_path / "compiled"
    shutil.copytree(compiled_layer, artifact)
    opened = load_artifact(artifact)
    update_plans(artifact, {**opened.plans, "some": replace(opened.plan(DENSE), cells=cells)}, DENSE)
    asked = list[Any]()

    def bac(clone: Path, fresh: Any, obs: Any, updates: Any, work: Path) -> dict[int, Stand]:
        asked.append((clone, obs["obs"].shape, tuple(updates), work.is_dir()))
        return {count: Stand(artifact, last) for count in updates}

    def evo(clone: Path, fresh: Any, given: PlanArray, work: Path) -> Stand:
        np.testing.assert_array_equal(given, last)
        return Stand(artifact, uniform_plan(steps, 3, 4))  # does something else

    monkeypatch.setattr(caching_beside, "original_policy", lambda clone, checkpoint: Stand(artifact, None))
    monkeypatch.setattr(caching_beside, "bac_policies", bac)
    monkeypatch.setattr(caching_beside, "evo_policy", evo)
    calls, checkpoint, output = tmp_path / "calls.npz", tmp_path / "policy.ckpt", tmp_path / "theirs"
    np.savez(calls, obs=np.random.default_rng(0).uniform(100, 400, (5, 2, 20)))
    checkpoint.touch()
    words = [str(artifact), str(checkpoint), str(tmp_path), "-t", str(calls), "-o", str(output), "--bac", str(tmp_path)]
    words += ["--evo", str(tmp_path), "--plans", "some", "--ours", "some", "--updates", "7", "--calls", "3"]
    words += ["--rounds", "1"]
    told = CliRunner().invoke(caching_beside.main, [*words, "--json"], catch_exceptions=False)
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert document["calls"] == 3
    dense, theirs, other, ours = document["rows"]
    names = ["the original", "bac-theirs-7", "some in EVO's code", "some"]
    assert [row["name"] for row in document["rows"]] == names
    assert [row["cells"] for row in document["rows"]] == [300, 34, 34, 31]
    assert (ours["apart"], ours["theirs_ms"]) == (None, None)
    assert ours["error"] > 1
    assert (dense["error"], dense["apart"]) == (0, 0)
    assert theirs["error"] > 1 > 1e-3 > theirs["apart"]
    assert other["apart"] > 1
    assert min(row[ms] for row in document["rows"][:3] for ms in ("theirs_ms", "ours_ms")) > 0
    assert asked == [(tmp_path, (1, 2, 20), (7,), True)]
    np.testing.assert_array_equal(load_artifact(output).plan("bac-theirs-7").cells, last)
    assert not (tmp_path / "theirs-work").exists()
    assert CliRunner().invoke(caching_beside.main, words, catch_exceptions=False).exit_code == 0


def test_evos_code_gets_no_cells_that_it_has_no_word_for(compiled_layer: Path, tmp_path: Path) -> None:
    artifact, cells = tmp_path / "compiled", np.full((100, 3), Source.FORWARD, np.int8)
    cells[0] = Source.COMPUTE
    shutil.copytree(compiled_layer, artifact)
    opened = load_artifact(artifact)
    update_plans(artifact, {**opened.plans, "along": replace(opened.plan(DENSE), cells=cells)}, DENSE)
    (tmp_path / "calls.npz").touch()
    words = [str(artifact), str(tmp_path / "calls.npz"), str(tmp_path), "-t", str(tmp_path / "calls.npz")]
    words += ["-o", str(tmp_path / "theirs"), "--evo", str(tmp_path), "--plans", "dense,along"]
    with pytest.raises(IllegalPlanError, match="along: EVO's code adds a block's last residual"):
        CliRunner().invoke(caching_beside.main, words, catch_exceptions=False)
    assert not list(tmp_path.glob("theirs*"))
