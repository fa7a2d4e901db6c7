"""BAC and EVO on the example's Push-T policy, against their authors' own code (``golden/README.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch

import ttscompile
from tests.rounding import PROMISED, bound
from ttscompile import Noise
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import Source, dense_plan
from ttscompile.core.plan import DENSE
from ttscompile.rivals.bac import best_schedules, bubbling, statistics, union
from ttscompile.runtimes.random_calls import normalized
from ttscompile.runtimes.reference.model import ReferenceModel

Arrays = Mapping[str, np.ndarray]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def golden() -> Arrays:
    with np.load(Path(__file__).with_name("golden") / "caching.npz") as arrays:
        return dict(arrays)


def apart(policy: ttscompile.CompiledPolicy, golden: Arrays, cells: np.ndarray, theirs: np.ndarray) -> float:
    """The largest difference of an action, in units of its range."""
    policy.reset()
    noise = Noise(golden["initial"], golden["noise"])
    mine = policy.predict_action({"obs": golden["obs"]}, noise=noise, plan=cells)["action_pred"]
    scale = policy.info.action.normalizer
    assert scale is not None
    return float((np.abs(np.asarray(mine) - theirs) * np.abs(scale.scale) / 2).max())


@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_their_cells_give_the_actions_that_their_code_gives(compiled_pusht: Path, golden: Arrays, runtime: str) -> None:
    policy = ttscompile.load(compiled_pusht, runtime)
    assert apart(policy, golden, dense_plan(100, 24), golden["dense"]) < PROMISED
    given = [
        *zip(golden["bac.cells"], golden["bac.actions"], strict=True),
        (golden["evo.cells"], golden["evo.actions"]),
    ]
    for cells, theirs in given:
        assert set(np.unique(cells)) == {Source.COMPUTE, Source.TIMESTEP}
        assert apart(policy, golden, cells, golden["dense"]) > 100 * PROMISED  # reuse is seen
        assert apart(policy, golden, cells, theirs) < PROMISED


def test_bac_makes_the_schedule_of_this_policy_that_its_authors_code_makes(
    compiled_pusht: Path, golden: Arrays
) -> None:
    """From a dense call of ours, whose residuals are theirs but for rounding: so are the scores, and the choices."""
    artifact = load_artifact(compiled_pusht)
    view = view_of(artifact, artifact.plan(DENSE))
    model, spec = ReferenceModel.from_view(view), view.manifest.spec
    obs = {key: torch.from_numpy(value) for key, value in normalized(spec, {"obs": golden["obs"]}).items()}
    steps, blocks = model.steps, model.blocks
    with torch.no_grad():
        given = model.prologue(obs), torch.from_numpy(golden["initial"]), torch.from_numpy(golden["noise"])
        found = model.denoise(*given, dense_plan(steps, blocks)).cache.residuals
    residuals = [torch.stack([found[k, b].reshape(1, -1) for k in range(steps)], 1) for b in range(blocks)]
    similarity, change = statistics(residuals)
    kinds = [block.kind for block in view.manifest.blocks]
    for count, scheduled, theirs in zip(golden["updates"], golden["bac.scheduled"], golden["bac.cells"], strict=True):
        best = [best_schedules(one, count)[-1] for one in similarity]
        own = [one.computed for one in best]
        for one, mine, other in zip(similarity, best, scheduled.T, strict=True):
            assert mine.score == pytest.approx(_score(one, other), rel=10 * bound(steps * residuals[0].shape[2]))
        cells = union(own, bubbling(change, kinds))
        cells[-1] = True  # their code computes every block at the last of 100 steps
        assert (cells != (theirs == Source.COMPUTE)).mean() < 0.01


def _score(similarity: np.ndarray, computed: np.ndarray) -> float:
    """How alike each step is to the one whose residual it takes, all steps together."""
    taken = np.maximum.accumulate(np.where(computed, np.arange(len(computed)), 0))
    return float(similarity[taken, np.arange(len(computed))].sum())
