"""Corrections among the arrays of an artifact: with and without jumps, and what is missing or too much."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.runtimes.plans import jumping
from ttscompile.artifact.corrections import correction_arrays, read_corrections
from ttscompile.artifact.manifest import PlanRecord
from ttscompile.core.correction import no_correction
from ttscompile.errors import ArtifactError

FIVE = [True, False, True, False, False]
WITH, WITHOUT = jumping(FIVE), no_correction(5, (4, 2))


def of_plans(*names: str) -> Any:
    """What a manifest says of a policy of five steps, with plans of these names."""
    plans, spec = {name: PlanRecord("all") for name in names}, SimpleNamespace(sample=(4, 2))
    return SimpleNamespace(
        plans=plans, whole_loop=lambda loop: loop, steps_of=lambda loop: 5, spec=spec, condition_numbers=7
    )


def test_what_is_stored_is_read_again() -> None:
    stored = {"a/b": np.zeros(1), **correction_arrays("fast", WITH), **correction_arrays("a/b", WITHOUT)}
    found = read_corrections(stored, of_plans("a/b", "fast", "other"), "here")
    assert set(found) == {"a/b", "fast"}
    assert not found["a/b"].landings and found["fast"].landings == {1: 0}
    np.testing.assert_array_equal(found["fast"].outer, WITH.outer)


def test_jumps_that_read_nothing_of_the_condition_have_inputs_for_it_in_a_single_file() -> None:
    blind = jumping(FIVE, read=0)
    found = read_corrections(correction_arrays("fast", blind), of_plans("fast"), "here")["fast"]
    inner = found.inputs()["correction_inner"]
    assert inner.shape == (1, 7 + 4 * 4 * 2 + 1, 128)
    assert not inner[:, :7].any()
    np.testing.assert_array_equal(inner[:, 7:], blind.inner)
    unknown = replace(blind, reading=np.zeros((0, 0), np.float32))
    with pytest.raises(ArtifactError, match="^here: fast: .*0 numbers of the condition.*this policy has 7"):
        read_corrections(correction_arrays("fast", unknown), of_plans("fast"), "here")


def test_one_without_jumps_has_no_arrays_for_them() -> None:
    """An artifact that has none is what it was before there were any."""
    named = {name.rpartition("/")[2] for name in correction_arrays("fast", WITHOUT)}
    assert named == {"anchors", "weights", "bias", "reading", "observed"}


def test_that_of_calls_with_a_prefix_stands_beside_that_of_others() -> None:
    """Where there is none, an artifact is what it was before there were any."""
    late = replace(WITH, prefixes=3)
    stored = correction_arrays("fast", replace(WITHOUT, late=late)) | correction_arrays("slow", WITH)
    found = read_corrections(stored, of_plans("fast", "slow"), "here")
    assert found["slow"].late is None and found["slow"].prefixes == found["fast"].prefixes == 0
    assert found["fast"].late is not None and found["fast"].late.prefixes == 3
    np.testing.assert_array_equal(found["fast"].late.outer, late.outer)
    assert not found["fast"].jumps
    alone = {name: array for name, array in stored.items() if name.startswith("correction/fast/late/")}
    twice = {name.replace("/late/", "/late/late/"): array for name, array in alone.items()}
    for wrong in (alone, stored | twice):
        with pytest.raises(ArtifactError, match="^here: expected corrections of plans among"):
            read_corrections(wrong, of_plans("fast", "slow"), "here")


@pytest.mark.parametrize("change", ["no plan", "less", "less of the jumps", "more"])
def test_others_are_refused(change: str) -> None:
    stored, plans = correction_arrays("fast", WITH), of_plans("fast")
    if change == "no plan":
        plans = of_plans("slow")
    elif change == "more":
        stored["correction/fast/more"] = np.zeros(1)
    else:
        del stored["correction/fast/" + ("bias" if change == "less" else "middle")]
    with pytest.raises(ArtifactError, match="^here: expected corrections of plans among"):
        read_corrections(stored, plans, "here")


def test_one_of_another_policy_is_refused_by_its_name() -> None:
    stored = correction_arrays("fast", no_correction(6, (4, 2)))
    with pytest.raises(ArtifactError, match="^here: fast: .*this policy needs"):
        read_corrections(stored, of_plans("fast"), "here")
