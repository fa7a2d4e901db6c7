"""Rules against what the authors' own code decides and forecasts (``golden/README.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.calibration.tasks import MakeTask
from tests.rounding import bound
from ttscompile.core.lattice import Source
from ttscompile.rivals.bac import best_schedules, bubbling, statistics, union
from ttscompile.rivals.gates import Gates
from ttscompile.rivals.online import Criterion, Decisions
from ttscompile.rivals.static import edge_plan
from ttscompile.rivals.taylorseer import forecast, schedules

Arrays = Mapping[str, np.ndarray]


@pytest.fixture(scope="module")
def golden() -> Arrays:
    found: dict[str, np.ndarray] = {}
    for name in ("rules", "schedules"):
        with np.load(Path(__file__).with_name("golden") / f"{name}.npz") as arrays:
            found |= arrays
    return found


def decided(rule: Criterion, features: np.ndarray) -> np.ndarray:
    """Which steps a criterion computes whole, of one stream."""
    decisions = Decisions(rule, len(features), rule.always + 1, 1)
    rows = [decisions.decide(k, feature[None]) for k, feature in enumerate(features)]
    return np.array([row[0, -1] == Source.COMPUTE for row in rows])


def test_teacache_computes_the_steps_that_its_authors_code_does(golden: Arrays) -> None:
    threshold, polynomial = float(golden["teacache.threshold"]), tuple(golden["teacache.polynomial"].tolist())
    rule = Criterion("teacache", 0, threshold, polynomial, accumulates=True, warmup=1, closes=True)
    assert 5 < golden["teacache.computed"].sum() < 19
    np.testing.assert_array_equal(decided(rule, golden["teacache.features"]), golden["teacache.computed"])


def test_dbcache_computes_the_steps_that_its_authors_code_does(golden: Arrays) -> None:
    threshold, warmup = float(golden["dbcache.threshold"]), int(golden["dbcache.warmup"])
    rule = Criterion("dbcache", 1, threshold, (1.0, 0.0), accumulates=False, warmup=warmup, closes=False)
    assert 5 < golden["dbcache.computed"].sum() < 19
    np.testing.assert_array_equal(decided(rule, golden["dbcache.features"]), golden["dbcache.computed"])


def test_taylorseer_computes_the_same_steps_and_forecasts_the_same(golden: Arrays) -> None:
    features, computed = golden["taylorseer.features"], np.flatnonzero(golden["taylorseer.computed"])
    steps = schedules(len(features), len(computed))[int(golden["taylorseer.warmup"])]
    np.testing.assert_array_equal(steps, computed)
    for k, given in enumerate(golden["taylorseer.given"]):
        before = [step for step in steps if step <= k]
        newest, older = forecast(k, before)
        mine = newest * features[before[-1]] + older * features[before[-2] if len(before) > 1 else 0]
        np.testing.assert_allclose(mine, given, atol=bound(8) * np.abs(features).max() * (newest - older), rtol=0)


def test_bac_computes_the_cells_that_its_authors_code_does(golden: Arrays) -> None:
    features, theirs = golden["bac.features"], golden["bac.computed"]
    similarity, change = statistics([rows[None] for rows in torch.from_numpy(features)])
    np.testing.assert_allclose(similarity, golden["bac.similarity"], atol=3 * bound(features.shape[2]), rtol=0)
    schedules = [best_schedules(one, max(golden["bac.updates"])) for one in similarity]
    followed = bubbling(change, ["self_attention", "feed_forward"] * (len(features) // 2))
    assert sorted(followed) == np.flatnonzero(golden["bac.bubbling"]).tolist()
    for count, scheduled, computed in zip(golden["bac.updates"], golden["bac.scheduled"], theirs, strict=True):
        own = [one[count - 1].computed for one in schedules]
        np.testing.assert_array_equal(own, scheduled)
        assert computed.sum() > scheduled.sum() == count * len(features)
        np.testing.assert_array_equal(union(own, followed).T, computed)


def test_l2c_computes_the_cells_that_its_authors_code_does(golden: Arrays, make_task: MakeTask) -> None:
    """Theirs has a threshold; with as many cells, ours are the same."""
    theirs, search = golden["l2c.computed"], Gates(make_task(34), Source.TIMESTEP, whole=2)
    search.restore({**search.state(), "scores": golden["l2c.scores"].astype(np.float64)})
    assert 30 < theirs.sum() < 60
    np.testing.assert_array_equal(search._cells(int(theirs.sum())) == Source.COMPUTE, theirs)


def test_deepcache_computes_the_parts_that_its_authors_code_does(golden: Arrays) -> None:
    """A branch of a U-Net is an edge of the chain that its parts are."""
    for branch, theirs in enumerate(golden["deepcache.computed"]):
        steps, parts = theirs.shape
        plan = edge_plan(steps, parts, steps // int(golden["deepcache.interval"]), branch + 1)
        np.testing.assert_array_equal(plan == Source.COMPUTE, theirs)
