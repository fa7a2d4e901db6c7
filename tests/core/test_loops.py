"""``PolicySpec.loops``: several denoising loops of one policy."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.passes.specs import toy_spec
from ttscompile import flow_matching_table
from ttscompile.errors import SpecError

TABLE = toy_spec(steps=3).sampler


@pytest.mark.parametrize("name", ["ddim-3", "dpmsolver++-16-trailing", "rk4.warm", "3", "a" * 64])
def test_a_loop_has_a_name_of_its_own(name: str) -> None:
    spec = replace(toy_spec(steps=5), loops={name: TABLE})
    assert list(spec.all_loops) == ["original", name]
    assert spec.all_loops["original"] is spec.sampler and spec.all_loops[name] is TABLE
    alone = spec.in_loop(name)
    assert (alone.sampler, dict(alone.loops), list(alone.all_loops)) == (TABLE, {}, ["original"])
    assert (alone.sample, alone.chunk, alone.observations) == (spec.sample, spec.chunk, spec.observations)
    own = spec.in_loop("original")
    assert own.sampler is spec.sampler and dict(own.loops) == {}


@pytest.mark.parametrize(
    "name", ["", "original", "DDIM-3", "ddim 3", "-3", ".", "../x", "a/b", "a@b", "ä", "a" * 65, 3]
)
def test_names_that_are_refused(name: Any) -> None:
    expected = "expected a name of lower-case letters, digits and .* and not 'original'"
    with pytest.raises(SpecError, match=expected):
        replace(toy_spec(), loops={name: TABLE})


def test_a_loop_that_is_not_there() -> None:
    with pytest.raises(SpecError, match="loop 'ddim-4': expected one of original, ddim-3"):
        replace(toy_spec(), loops={"ddim-3": TABLE}).in_loop("ddim-4")


def test_timesteps_of_two_kinds_are_refused() -> None:
    """The network is captured with one of them."""
    with pytest.raises(SpecError, match="loop 'euler-4': its timesteps are float32, and .* int64"):
        replace(toy_spec(), loops={"euler-4": flow_matching_table(4)})


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({}, True),
        ({"name": "other"}, False),
        ({"clip": 1.0}, False),
        ({"noise_to_next": np.full(3, 1e-6, np.float32)}, False),
        ({"timesteps": np.array([2, 1, 3])}, False),
        ({"memory_to_next": np.ones((3, 1), np.float32), "to_memory": np.zeros((3, 1, 4), np.float32)}, False),
    ],
)
def test_whether_two_tables_are_the_same(change: dict[str, Any], same: bool) -> None:
    other = replace(TABLE, **change)
    assert TABLE.same_as(other) is other.same_as(TABLE) is same
    assert not TABLE.same_as(toy_spec(steps=4).sampler)
