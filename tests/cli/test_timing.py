"""The eager baseline is timed on the artifact's own policy, or not at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.passes.specs import toy_spec
from ttscompile import Affine
from ttscompile.cli.timing import _different_statistics
from ttscompile.measure.units import ms


def test_policies_of_one_shape_are_told_apart_by_their_statistics() -> None:
    plain = toy_spec()
    scaled = Affine(np.full(3, 2.0), np.zeros(3))
    observed = replace(plain, observations={"obs": replace(plain.observations["obs"], normalizer=scaled)})
    acting = replace(plain, chunk=replace(plain.chunk, normalizer=Affine(np.ones(2), np.ones(2))))
    moved = replace(plain, chunk=replace(plain.chunk, normalizer=Affine(np.ones(2), np.zeros(2))))
    assert _different_statistics(plain, plain) == []
    assert _different_statistics(observed, observed) == []
    assert _different_statistics(plain, observed) == ["observation 'obs'"]
    assert _different_statistics(acting, moved) == ["the action"]


def test_long_times_have_no_exponent() -> None:
    assert [ms(time, 4) for time in (0.12345, 33.274, 9999.4, 11630.2)] == ["0.1235", "33.27", "9999", "11630"]
    assert [ms(time) for time in (33.27, 1030.4)] == ["33.3", "1030"]
