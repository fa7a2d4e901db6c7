"""Parts in another precision: are their integers the weights, rounded, and does a call give what it should?"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from ..artifact import tensors
from ..artifact.golden import Golden, GoldenPlan
from ..artifact.load import Artifact
from ..core.coercion import Array, Arrays
from ..core.four_bits import BLOCK, further_off
from ..core.spec import INT4, INT8
from ..errors import ArtifactError
from ..runtimes.runtime import Runtime
from .calls import VALUE, computed, replay
from .rung import FAILED, PASSED, Rung, finite, judged

PRECISION, PLANS_PRECISION = "precision", "precision of plans"

EIGHT_BITS = 0.1
"""Tolerance of a denoised sample of a dense call: the norm of its error as a share of its own.

The range of 255 steps that a product reads is about 8 standard deviations of what it reads, and the largest of 127 in a
column of weights about 4. Rounding to the nearest is off by a root of 1/12 of a step, which is 0.9 % of a deviation of
either and 1.3 % of one of the product. A residual is a chain of four products at most: 2.6 %. Residuals add up, and so
do their errors, whose share stays. A tolerance of four times that leaves room for what is no normal distribution. A
single number may be further off: where a policy has two ways to act, rounding chooses."""

FOUR_BITS = 0.4
"""The same in four bits. A block of 64 numbers in 16 steps is off by 9 % of their deviation, a product with them by as
much, and a chain of four by 18 %. Twice that is left to other distributions. A call further off is another call."""

CARRIED = 2.0
"""How much more than a dense call a plan may differ: an error that is made in one step is reused in those after it.
Push-T in int8: 1.8 to 4.6 times a dense call's, which has a fourteenth of its tolerance."""

HALF = 0.501
"""Of a step: by so much a number may be off that was rounded in float32."""

_SUFFIX, _FOUR, _SCALE = f".{INT8}", f".{INT4}", ".scale"


def check_precision(artifact: Artifact, golden: Golden, runtime: Runtime) -> Rung | None:
    """Weights in another precision than fp32 against those in it, and dense calls with them against the original.

    None if no part has any.
    """
    record, spec = artifact.manifest.precision, artifact.manifest.spec
    if record is None:
        return None
    off, constant = max(_steps_off(artifact))
    if not off <= HALF:
        told = f"the integers of {constant!r} are up to {off:.3g} of their steps off; rounded weights are half of one"
        remedy = "They were changed or exchanged: convert the checkpoint again."
        return Rung(PRECISION, FAILED, told, off, HALF, "of a step", remedy)
    obs, error = golden.network_observations(spec), 0.0
    for loop in spec.all_loops:
        own, plan = golden.in_loop(loop), computed(artifact, loop, artifact.manifest.held)
        runtime.reset()
        share = np.linalg.norm(runtime.predict(obs, own.noise, plan)[0] - own.sample) / np.linalg.norm(own.sample)
        error = max(error, float(share) if np.isfinite(share) else math.inf)
    told = f"a dense call with {record.told} against the original"
    remedy = "Take plans in fp32 (plan.exact), or convert the checkpoint again."
    return judged(PRECISION, error, _tolerance(record.name), "of the sample's norm", told, remedy)


def check_plans_precision(
    artifact: Artifact, golden: Golden, recorded: Mapping[str, GoldenPlan], runtime: Runtime
) -> Rung | None:
    """The same episodes of plans with parts of another precision than fp32; None if there are none.

    The record is made in fp32, so that the samples differ by what the precision does to them.
    """
    precision = artifact.manifest.precision
    own = {name: record for name, record in recorded.items() if artifact.plans[name].precision}
    if precision is None or not own:
        return None
    tolerance = CARRIED * _tolerance(precision.name)
    errors, wrong = dict[str, float](), dict[str, str]()
    for name, record in own.items():
        plan = replace(artifact.plans[name], tokens=None)  # what is recorded knows of no frames before
        _, differ, few, errors[name] = replay(artifact, golden, runtime, plan, record)
        if not few:
            wrong[name] = f"{name!r} in {np.count_nonzero(differ)} of {differ.size} cells"
        elif not errors[name] <= tolerance:
            wrong[name] = f"the samples of {name!r} by {errors[name]:.2g}"
    each = ", ".join(f"{name} {error:.2g}" for name, error in errors.items())
    told = f"samples, normalised, differ by {each}: two calls with {precision.told} against those in fp32"
    status, remedy = PASSED, ""
    if wrong:
        told = f"with {precision.told} plans are not what calibration stored of fp32: {', '.join(wrong.values())}"
        status, remedy = FAILED, "Take plans in fp32 (plan.exact), or convert the checkpoint again and calibrate."
    details = {"errors": {name: finite(error) for name, error in errors.items()}}
    return Rung(PLANS_PRECISION, status, told, finite(max(errors.values())), tolerance, VALUE, remedy, details=details)


def _tolerance(precision: str) -> float:
    return FOUR_BITS if precision == INT4 else EIGHT_BITS


def _steps_off(artifact: Artifact) -> Iterator[tuple[float, str]]:
    """How far the integers of each matrix are from the weights that they stand for, in steps; and its name."""
    manifest = artifact.manifest
    assert manifest.precision is not None
    yield from _apart(artifact, manifest.precision.weights, artifact.weights)
    for name, record in manifest.weights.items():
        if record.precision_weights is not None:
            yield from _apart(artifact, record.precision_weights, {**artifact.weights, **artifact.block_weights[name]})


def _apart(artifact: Artifact, file: str, weights: Arrays) -> Iterator[tuple[float, str]]:
    with artifact.reading(file):
        stored = tensors.read(artifact.files / file)
        for name, integers in stored.items():
            if integers.dtype not in (np.int8, np.uint8):
                continue
            four, scale = integers.dtype == np.uint8, stored[f"{name}{_SCALE}"]
            constant = name[: name.rindex(_FOUR if four else _SUFFIX)]
            weight = np.asarray(weights.get(constant, np.zeros(0, np.float32)))
            if weight.size != integers.size if not four else not _packs(integers, weight):
                found = f"{name!r}, {integers.size} integers that stand for no constant of as many numbers"
                raise ArtifactError(f"{artifact.path}: {file}: {found}. Convert the checkpoint again.")
            yield (_off_in_four if four else _off)(integers, scale, weight), constant


def _packs(integers: Array, weight: Array) -> bool:
    """Whether packed integers may be of a matrix, or of the same turned."""
    sizes = integers.shape[1], len(integers)
    shapes = (weight.shape, weight.shape[::-1])
    return weight.ndim == 2 and any((math.ceil(rows / BLOCK), columns) == sizes for rows, columns in shapes)


def _off_in_four(integers: Array, scale: npt.NDArray[np.float32], weight: Array) -> float:
    """The largest difference of a block from a matrix, or the same turned, where half a step is plain rounding's."""
    turned = [one for one in (weight, weight.T) if one.shape[1] == len(integers)]
    return min(further_off(integers, scale, one) / 2 for one in turned if math.ceil(len(one) / BLOCK) == len(scale.T))


def _off(integers: Array, scale: npt.NDArray[np.float32], weight: Array) -> float:
    """The largest difference of integers ``[rows, columns]`` from a constant that they were made of, in steps.

    Some axes of the constant are the columns, and the numbers of a column may have another order there: they are
    compared as sets. Sorting brings no two sets further apart than they are element by element, so those that were
    rounded are half a step apart at most.
    """
    if scale.ndim > 1:  # of a table, by row
        integers, scale = integers.T, scale[:, 0]
    made, (rows, columns), found = np.sort(integers * scale, 0), integers.shape, [np.inf]
    for i, j in combinations(range(weight.ndim + 1), 2):
        if math.prod(weight.shape[i:j]) == columns:
            by_column = weight.reshape(math.prod(weight.shape[:i]), columns, -1).swapaxes(1, 2).reshape(rows, columns)
            found.append(float((np.abs(made - np.sort(by_column, 0)) / scale).max()))
    return min(found)
