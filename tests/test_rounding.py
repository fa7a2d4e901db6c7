"""Tolerances of ``tests/rounding.py``: any order of summation stays within them, and what a defect changes does not."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from torch import nn

from tests.families.heads import FAMILIES, loaded
from tests.rounding import FLOAT64, Counted, allowed, amplified, assert_equal_but_for_rounding, bound
from ttscompile import flow_matching_table

WIDTHS = (4, 64, 1024, 16384)

Array = np.ndarray


def in_lanes(terms: Array, lanes: int) -> Array:
    """Sums over the last axis as vector instructions make them: every lane its own, one term after the other."""
    parts = np.zeros((*terms.shape[:-1], lanes), np.float32)
    for first in range(0, terms.shape[-1], lanes):
        parts += terms[..., first : first + lanes]
    while parts.shape[-1] > 1:
        parts = parts[..., ::2] + parts[..., 1::2]
    return parts[..., 0]


@pytest.mark.parametrize("width", WIDTHS)
def test_sums_in_any_order_are_within_the_bound(width: int) -> None:
    """One after the other, forwards and backwards, and in the lanes of SSE, AVX2 and AVX-512, and of two."""
    rng = np.random.default_rng(width)
    for _ in range(5):
        x, w = rng.standard_normal((64, width), np.float32), rng.standard_normal((64, width), np.float32)
        terms = x * w / np.float32(math.sqrt(width))
        exact = terms.sum(-1, dtype=np.float64)
        sums = [in_lanes(terms, lanes) for lanes in (1, 2, 4, 8, 16, 32) if lanes <= width]
        sums.append(in_lanes(terms[:, ::-1], 1))
        for one in sums:
            assert_equal_but_for_rounding(one, exact, width)
            for other in sums:
                assert_equal_but_for_rounding(one, other, width)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_sum_without_a_term_or_in_half_precision_is_not(width: int) -> None:
    rng = np.random.default_rng(width)
    terms = rng.standard_normal((64, width), np.float32) / np.float32(math.sqrt(width))
    exact = terms.sum(-1, dtype=np.float64)
    tolerance = allowed(exact, width)
    assert np.abs(terms[:, 1:].sum(-1) - exact).max() > 50 * tolerance
    assert np.abs(terms.astype(np.float16).sum(-1, dtype=np.float64) - exact).max() > 5 * tolerance
    assert np.abs(exact.astype(np.float16) - exact).max() > 5 * tolerance


def waves(times: Array, dtype: type) -> Array:
    """Embedding of timesteps as everybody writes it, in float32 or float64."""
    rates = np.exp(-math.log(10000) * np.arange(128, dtype=dtype) / dtype(128))
    angle = times.astype(dtype)[:, None] * rates
    return np.concatenate([np.cos(angle), np.sin(angle)], -1)


def test_waves_are_as_far_off_as_their_angles_and_the_next_timestep_is_further() -> None:
    rng = np.random.default_rng(0)
    weights = rng.standard_normal((256, 64)) / 16
    for largest in (10, 100, 1000):
        times = np.arange(largest // 2, largest + 1)
        exact, found = (waves(times, dtype) @ weights for dtype in (np.float64, np.float32))
        following = waves(times + 1, np.float64) @ weights
        tolerance = allowed(exact, 256, largest)
        assert np.abs(found - exact).max() < tolerance
        assert np.abs(following - exact).max(axis=1).min() > 1000 * tolerance


def defects(module: nn.Module) -> dict[str, nn.Module]:
    """The module in half precision, and without each of its biases that has a say."""
    made = {"half": copy.deepcopy(module)}
    for parameter in made["half"].parameters():
        parameter.copy_(parameter.half().float())
    for name, parameter in module.named_parameters():
        # The bias of keys adds the same to all of a query's logits, which a softmax does not see.
        if name.endswith("bias") and "to_k" not in name and parameter.abs().max() > 0:
            made[name] = copy.deepcopy(module)
            made[name].get_parameter(name).zero_()
    return made


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_defects_of_an_action_head_are_far_outside(name: str) -> None:
    """The tolerance of ``test_a_head_computes_what_the_original_computes`` against what it has to find."""
    family = FAMILIES[name]()
    module, arrays, _ = loaded(family, name)
    inputs = {key: torch.from_numpy(arrays[key]) for key in family.conditions}
    sample, timesteps = torch.from_numpy(arrays["noise"]), torch.from_numpy(arrays["timesteps"]) / family.scale
    with torch.no_grad():
        with Counted() as counted:
            expected = module(sample, timesteps, **inputs)
        tolerance = allowed(expected, counted.terms, counted.angle)
        for defect, changed in defects(module).items():
            difference = float((changed(sample, timesteps, **inputs) - expected).abs().max())
            assert difference > 5 * tolerance, defect
        whole = 0.001 if timesteps.max() <= 1 else 1.0  # one in a thousand
        beside = timesteps + whole * torch.tensor([1, -1])
        assert float((module(sample, beside, **inputs) - expected).abs().max()) > 50 * tolerance


def test_what_is_counted() -> None:
    """By hand: a convolution, a product, an attention, a norm, a mean, an addition, functions; angles of float32."""
    functional, x = nn.functional, torch.ones(1, 2, 4, 8)
    image, kernel, left, right = (torch.ones(shape) for shape in ((1, 3, 5, 5), (2, 3, 3, 3), (2, 7), (7, 5)))
    wide = torch.ones(3, 18)
    with Counted() as counted:
        functional.conv2d(image, kernel)
    assert counted.terms == 27 + 1
    with Counted() as counted:
        left @ right
    assert counted.terms == 7
    with torch.inference_mode(), Counted() as counted:
        functional.linear(functional.conv2d(image, kernel).flatten(1), wide)
    assert counted.terms == 28 + 18
    with Counted() as counted:
        functional.scaled_dot_product_attention(x, x, x)
    assert counted.terms == 8 + 4 + 16
    with Counted() as counted:
        functional.layer_norm(x, (8,))
    assert counted.terms == 8
    with Counted() as counted:
        x.mean(-1)
    assert counted.terms == 8
    with Counted() as counted:
        (x + x).transpose(0, 1).unsqueeze(0)
    assert (counted.terms, counted.angle) == (1, 0.0)
    with Counted() as counted:
        functional.gelu(x.tanh())
    assert counted.terms == 16 + 16
    with Counted() as counted:
        (3 * x).sin()
        (50 * x.double()).cos()
    assert counted.angle == 3.0


def test_a_sampler_that_averages_amplifies_nothing() -> None:
    """Euler's predictions have a tenth each; one that takes each for ten has the squares of that."""
    table = flow_matching_table(10)
    assert amplified(100, table) == 100
    wider = flow_matching_table(np.linspace(0, 100, 11).tolist())
    assert amplified(100, wider) == pytest.approx(100 * 10**2)


def test_the_assertion_says_what_is_too_far_and_of_which_shape() -> None:
    expected = torch.tensor([1.0, -2.0, np.inf])
    assert allowed(expected, 16) == 2 * bound(16)
    assert bound(16, unit=FLOAT64) < 1e-8 * bound(16)
    assert_equal_but_for_rounding(expected + bound(16), expected, 16)
    with pytest.raises(AssertionError, match="Mismatched elements"):
        assert_equal_but_for_rounding(expected + 4 * bound(16), expected, 16)
    with pytest.raises(AssertionError):
        assert_equal_but_for_rounding(expected[:1], expected, 16)
