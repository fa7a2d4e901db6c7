"""Criteria decide by hand-computed numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ttscompile.core.lattice import Source
from ttscompile.errors import ArtifactError, IllegalPlanError
from ttscompile.rivals.online import Criterion, Decisions, relative_change

TEACACHE = Criterion("teacache", 0, 1.0, (2.0, 0.0), accumulates=True, warmup=1, closes=True)
DBCACHE = Criterion("dbcache", 1, 0.5, (1.0, 0.0), accumulates=False, warmup=1, closes=False)


def decided(rule: Criterion, features: list[list[float]]) -> list[str]:
    """Of each stream, a word with a C for each step that is computed whole; ``features[k]`` has one number a stream."""
    decisions = Decisions(rule, len(features), 3, len(features[0]))
    words = [""] * len(features[0])
    for k, row in enumerate(features):
        found = decisions.decide(k, np.array(row, np.float32)[:, None])
        assert found.shape == (len(row), 3)
        assert (found[:, : rule.always] == Source.COMPUTE).all()
        for i, cells in enumerate(found[:, rule.always :]):
            assert len(set(cells)) == 1
            words[i] += "C" if cells[0] == Source.COMPUTE else "."
            assert cells[0] in (Source.COMPUTE, Source.TIMESTEP)
    return words


def test_relative_change() -> None:
    before = np.array([[1, -1], [2, 0]], np.float32)
    now = np.array([[2, -1], [2, 2]], np.float32)
    np.testing.assert_allclose(relative_change(now, before), [0.5, 1.0])
    assert np.isfinite(relative_change(now, np.zeros_like(now))).all()


def test_changes_add_up_until_the_threshold_and_begin_anew() -> None:
    # Twice the relative change: 0.5, then 0.5 more is 1.0: computed; then 0.25 each.
    features = [[16.0], [20.0], [25.0], [28.125], [31.640625], [31.640625]]
    assert decided(TEACACHE, features) == ["C.C..C"]
    assert decided(replace(TEACACHE, closes=False), features) == ["C.C..."]


def test_a_change_below_nothing_counts_as_nothing() -> None:
    falling = replace(TEACACHE, polynomial=(-1.0, 0.0), closes=False)
    assert decided(falling, [[1.0], [9.0], [1.0], [9.0]]) == ["C..."]


def test_a_change_is_held_against_the_last_whole_step() -> None:
    # 10 -> 12 -> 14 -> 15: half as much again as 10, though no step changes by as much; then 20 against 15.
    assert decided(DBCACHE, [[10.0], [12.0], [14.0], [15.0], [20.0], [22.5]]) == ["C..C.C"]


def test_warm_up_steps_are_whole_and_are_what_is_compared_with() -> None:
    assert decided(replace(DBCACHE, warmup=3), [[10.0], [10.0], [14.0], [15.0], [21.0]]) == ["CCC.C"]


def test_streams_decide_on_their_own() -> None:
    features = [[10.0, 10.0], [10.0, 16.0], [16.0, 16.0], [16.0, 9.0]]
    assert decided(DBCACHE, features) == ["C.C.", "CC.."]
    assert decided(DBCACHE, [[row[1]] for row in features]) == ["CC.."]


def test_decisions_do_not_hold_on_to_the_feature() -> None:
    decisions = Decisions(DBCACHE, 3, 2, 1)
    feature = np.array([[10.0]], np.float32)
    decisions.decide(0, feature)
    feature[0] = 20.0  # a runtime's buffer, used again
    assert decisions.decide(1, feature)[0, 1] == Source.COMPUTE


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"polynomial": ()}, "polynomial"),
        ({"warmup": 0}, "warmup"),
        ({"always": -1}, "always"),
        ({"threshold": float("inf")}, "threshold"),
    ],
)
def test_numbers_that_cannot_be_are_refused(change: dict[str, Any], named: str) -> None:
    with pytest.raises(ArtifactError, match=named):
        replace(TEACACHE, **change)


def test_a_policy_with_nothing_left_to_decide_is_refused() -> None:
    with pytest.raises(IllegalPlanError, match="first 1 blocks at every step; the policy has 1"):
        Decisions(DBCACHE, 10, 1, 2)


def test_a_record_is_read_as_it_was_written() -> None:
    for rule in (TEACACHE, DBCACHE):
        assert Criterion.of_record(json.loads(json.dumps(rule.record()))) == rule


@pytest.mark.parametrize(
    "change",
    [
        {"threshold": "0.5"},
        {"threshold": True},
        {"always": 1.0},
        {"polynomial": 1.0},
        {"polynomial": ["1", 0]},
        {"polynomial": [[1.0]]},
        {"more": 1},
        {"closes": None},
        {"warmup": 10**400},
        {"threshold": float("nan")},
    ],
)
def test_a_hostile_record_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ArtifactError, match=r"Calibrate again\."):
        Criterion.of_record({**TEACACHE.record(), **change} if change != {"warmup": 10**400} else {"warmup": 10**400})
    lacking = {name: one for name, one in TEACACHE.record().items() if name != "warmup"}
    with pytest.raises(ArtifactError, match="the record of a criterion has name: str, always: int"):
        Criterion.of_record(lacking)
