"""Rules against what the authors' own code decides and forecasts (``golden/README.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from tests.rounding import bound
from ttscompile.core.lattice import Source
from ttscompile.rivals.online import Criterion, Decisions
from ttscompile.rivals.taylorseer import forecast, schedules

Arrays = Mapping[str, np.ndarray]


@pytest.fixture(scope="module")
def golden() -> Arrays:
    with np.load(Path(__file__).with_name("golden") / "rules.npz") as arrays:
        return dict(arrays)


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
