"""What callers give: numpy arrays or torch tensors, checked against the policy's specification. Imports no torch."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import FloatArray, Noise, ObservationSpec, PolicySpec
from ttscompile.errors import ObservationError, TtscompileError

Array: TypeAlias = npt.NDArray[Any]


def is_tensor(value: object) -> bool:
    """Whether this is a torch tensor; if torch was never imported, nothing is."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def check_seed(seed: int | None) -> int | None:
    """The seed, or None for none.

    Raises:
        TtscompileError: not a whole number of at least 0.
    """
    if seed is None or (isinstance(seed, int | np.integer) and not isinstance(seed, bool) and seed >= 0):
        return seed
    raise TtscompileError(f"seed: expected an integer of at least 0, or None for another sequence; found {seed!r}.")


def as_array(value: Any, what: str) -> Array:
    """The numpy array of an array or tensor; no copy if it can be helped.

    Args:
        value: what the caller gave.
        what: for the message, ``observation 'obs'``.

    Raises:
        ObservationError: neither an array nor a tensor, or a tensor of a dtype that numpy lacks.
    """
    if is_tensor(value):
        try:
            array: Array = value.detach().cpu().numpy()
        except TypeError as error:
            problem = f"{what} is a tensor of dtype {value.dtype}, which numpy does not have"
            raise ObservationError(f"{problem}. Convert it with .float().") from error
        return array
    if isinstance(value, np.ndarray):
        return value
    expected = "expected a numpy array or a torch tensor. Use np.asarray(..., dtype=np.float32)."
    raise ObservationError(f"{what} is a {type(value).__name__}; {expected}")


def like(array: Array, example: Any) -> Any:
    """The array as the kind that the caller uses: a tensor on the device of ``example``, or as it is."""
    if not is_tensor(example):
        return array
    return sys.modules["torch"].from_numpy(array).to(example.device)


def check_observation(obs: Mapping[str, Any], specs: Mapping[str, ObservationSpec]) -> dict[str, Array]:
    """Observations as numpy arrays ``[B, ...]`` of their specified shapes and dtypes, finite, with one B.

    Raises:
        ObservationError: names the key, what was expected, what was found and the remedy.
    """
    if not isinstance(obs, Mapping):
        expected = f"a dictionary with the keys {sorted(specs)}"
        raise ObservationError(f"the observation is a {type(obs).__name__}; expected {expected}.")
    missing, unexpected = sorted(set(specs) - set(obs)), sorted(map(str, set(obs) - set(specs)))
    if missing or unexpected:
        found = f"{sorted(map(str, obs))} (missing: {missing}, unexpected: {unexpected})"
        remedy = "Give exactly the keys that the policy was compiled for."
        raise ObservationError(f"expected the observation keys {sorted(specs)}; found {found}. {remedy}")
    arrays = {key: _one(key, as_array(obs[key], f"observation {key!r}"), spec) for key, spec in specs.items()}
    counts = {key: len(array) for key, array in arrays.items()}
    if len(set(counts.values())) > 1:
        differ = f"observations hold different numbers of streams: {counts}"
        raise ObservationError(f"{differ}. The first axis of all must be the same.")
    return arrays


def _one(key: str, array: Array, spec: ObservationSpec) -> Array:
    expected = f"{spec.dtype} [B, {', '.join(map(str, spec.shape))}]"
    found = f"{array.dtype} {list(array.shape)}"
    if array.shape[1:] != spec.shape or array.ndim != len(spec.shape) + 1 or len(array) < 1:
        single = " A single stream needs a first axis of 1: use obs[None]."
        remedy = single if array.shape == spec.shape else _image_remedy(array, spec)
        raise ObservationError(f"observation {key!r} has the wrong shape: expected {expected}; found {found}.{remedy}")
    if str(array.dtype) != spec.dtype:
        remedy = f" Convert it with .astype(np.{spec.dtype}), after making sure that its units are those of training."
        remedy = _image_remedy(array, spec) or remedy
        raise ObservationError(f"observation {key!r} has the wrong dtype: expected {expected}; found {found}.{remedy}")
    check_finite(array, f"observation {key!r}", "Look for the sensor, or the division, that made it.")
    _check_bounds(key, array, spec)
    return array


def _check_bounds(key: str, array: Array, spec: ObservationSpec) -> None:
    """Raise unless the numbers of tokens and images are within their bounds.

    Images may overshoot by a tenth of the range, as resizing with a cubic filter does at edges. One of 0..255 in place
    of 0..1 would give actions that look like actions.
    """
    if spec.bounds is None or not (spec.image or array.dtype.kind in "iu"):
        return
    low, high = (np.asarray(each) for each in spec.bounds)
    if not spec.image:
        if (array < low).any() or (array > high).any():
            found = f"integers of {low.min():.0f} to {high.max():.0f}; found {array.min()} to {array.max()}"
            remedy = "Tokens must come from the tokenizer that the policy was trained with."
            raise ObservationError(f"observation {key!r} must hold {found}. {remedy}")
        return
    least, most, room = float(array.min()), float(array.max()), 0.1 * float(high[0] - low[0])
    if least < low[0] - room or most > high[0] + room:
        remedy = "Give what the camera measures, not normalised: the policy does that itself."
        if most > high[0] + room and least >= 0 and high[0] == 1:
            remedy = "Divide by 255, channels first."
        found = f"numbers of {low[0]:g} to {high[0]:g}; found {least:.6g} to {most:.6g}"
        raise ObservationError(f"observation {key!r} is an image and must hold {found}. {remedy}")


def _image_remedy(array: Array, spec: ObservationSpec) -> str:
    """What to do with an image of bytes, or with its channels last; nothing for other arrays."""
    remedy = ""
    if spec.image and array.dtype.kind in "iu":
        remedy += f" Divide by 255, channels first: image.astype(np.{spec.dtype}) / 255."
    if spec.image and array.shape[-3:] == (*spec.shape[-2:], spec.shape[-3]) != spec.shape[-3:]:
        remedy += " Its channels are last: use np.moveaxis(image, -1, -3)."
    return remedy


def check_finite(array: Array, what: str, remedy: str) -> None:
    """Raise if an array of floats holds NaN or infinity.

    Raises:
        ObservationError: says how many and where the first is.
    """
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return
    bad = np.argwhere(~np.isfinite(array))
    first = tuple(bad[0].tolist())
    found = f"{array[first]} at index {first}, {len(bad)} such values in all"
    raise ObservationError(f"{what} must be finite; found {found}. {remedy}")


def check_noise(noise: Noise, streams: int, spec: PolicySpec) -> Noise:
    """The noise of a call as float32 arrays that fit it.

    Args:
        noise: the caller's; where the policy predicts fewer steps than the original, with as many as either. If the
            sampler draws no noise in its steps, ``noise.steps`` is not looked at.
        streams: B of the observation.
        spec: of the policy.

    Raises:
        ObservationError: missing, of the wrong shape or dtype, or not finite.
    """
    if not isinstance(noise, Noise):
        raise ObservationError(f"noise is a {type(noise).__name__}; expected ttscompile.Noise(initial, steps).")
    one = (streams, *spec.sample)
    initial = _noise(noise.initial, "noise.initial", "[B, T, D]", one, spec.left_out)
    if not spec.sampler.stochastic:
        return Noise(initial)
    shape = (spec.sampler.steps, *one)
    if noise.steps is None:
        remedy = f"Give [K, B, T, D] = {shape}, or noise=None to have all of it drawn."
        raise ObservationError(f"noise.steps is missing: the sampler draws noise in its steps. {remedy}")
    return Noise(initial, _noise(noise.steps, "noise.steps", "[K, B, T, D]", shape, spec.left_out))


def _noise(value: Any, what: str, axes: str, shape: tuple[int, ...], left_out: int) -> FloatArray:
    array = as_array(value, what)
    if left_out and array.shape == (*shape[:-2], shape[-2] + left_out, shape[-1]):
        array = array[..., : shape[-2], :]
    if array.shape != shape or array.dtype != np.float32:
        expected = f"float32 {axes} = {list(shape)}; found {array.dtype} {list(array.shape)}"
        raise ObservationError(f"{what} must be {expected}. Use rng.standard_normal(shape, dtype=np.float32).")
    check_finite(array, what, "Draw it again.")
    return array
