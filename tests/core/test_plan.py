"""A plan is checked where it is made: who makes one of other fields learns at once what is wrong."""

import math
from typing import Any

import numpy as np
import pytest

from ttscompile import Plan, TokenReuse
from ttscompile.errors import IllegalPlanError


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"weights": None}, "weights: expected a name; found None"),
        ({"correction": 3}, "correction: expected a Correction, or None; found 3"),
        ({"tokens": 0.5}, "tokens: expected a TokenReuse, or None; found 0.5"),
        ({"otherwise": "full"}, "otherwise: expected a Plan, or None; found 'full'"),
        ({"precision": "int8"}, "precision: expected a precision by part, .*; found 'int8'"),
    ],
)
def test_a_field_of_another_kind_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(IllegalPlanError, match=f"a plan's {message}"):
        Plan(**fields)


@pytest.mark.parametrize("threshold", [math.nan, -1.0, "a", True, None])
def test_a_threshold_is_a_number_that_is_not_negative(threshold: Any) -> None:
    """NaN would have no patch changed, whatever the camera shows."""
    with pytest.raises(IllegalPlanError, match="threshold of a plan's tokens: expected a number that is not negative"):
        TokenReuse(threshold, 8)


@pytest.mark.parametrize("share", [math.nan, -1.0, -1, "a", True])
def test_a_share_for_scenes_is_one_too(share: Any) -> None:
    told = "scene of a plan's tokens: expected a number that is not negative; found "
    with pytest.raises(IllegalPlanError, match=f"{told}{share!r}"):
        TokenReuse(0.1, 8, scene=share)


def test_without_a_share_scenes_are_whole() -> None:
    """The one that is given is part of what a plan is, as is that none is."""
    assert TokenReuse(0.1, 8).scene is None
    assert TokenReuse(0.1, 8, np.float32(0.5)) == TokenReuse(0.1, 8, scene=0.5)  # type: ignore[arg-type]
    assert type(TokenReuse(0.1, 8, np.float32(0.5)).scene) is float  # type: ignore[arg-type]
    whole, some = (Plan(tokens=TokenReuse(0.1, 8, share)) for share in (None, 0.0))
    assert whole != some and whole.variant != some.variant
    assert whole.exact.tokens is some.exact.tokens is None


@pytest.mark.parametrize(
    ("reuse", "told"),
    [
        (None, ""),
        (TokenReuse(0.1, 8), ", some tokens of each new frame"),
        (TokenReuse(0.1, 8, 0.0), ", some tokens of each new frame and scene"),
    ],
)
def test_a_plan_says_of_what_some_tokens_are_computed(reuse: TokenReuse | None, told: str) -> None:
    assert Plan(tokens=reuse).in_words() == f"the steps of original that the pruner chooses{told}"
    cells = np.zeros((5, 2), np.int8)
    assert Plan(cells=cells, tokens=reuse).in_words() == f"5 of 5 steps of original{told}"


@pytest.mark.parametrize("refresh", [0, -3, 1.5, math.nan, "8"])
def test_a_refresh_is_a_count(refresh: Any) -> None:
    with pytest.raises(IllegalPlanError, match="refresh of a plan's tokens must be an integer of at least 1"):
        TokenReuse(0.1, refresh)


def test_numbers_of_numpy_are_numbers() -> None:
    reuse = TokenReuse(np.float32(0.5), np.int64(8))  # type: ignore[arg-type]
    assert (type(reuse.threshold), type(reuse.refresh)) == (float, int)
    assert reuse == TokenReuse(0.5, 8) == TokenReuse(threshold=0.5, refresh=8)
