"""What callers give, checked against the policy's specification. Imports no torch.

Everything comes through ``core.coercion.plain`` first, so that what is checked here is what is computed with.
"""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from ttscompile.core.coercion import Array, Arrays, integer, is_tensor, plain
from ttscompile.core.spec import FloatArray, Noise, ObservationSpec, PolicySpec
from ttscompile.core.values import check_numbers, check_values, fitted
from ttscompile.errors import ObservationError, TtscompileError

_MISSING = object()


def check_seed(seed: int | None) -> int | None:
    """The seed as Python's integer, or None for none. Raises TtscompileError: not a whole number of at least 0."""
    return None if seed is None else integer(seed, "seed", TtscompileError, more=", or None for another sequence")


def like(array: Array, example: Any) -> Any:
    """The array as the kind that the caller uses: a tensor on the device of ``example``, or as it is."""
    if not is_tensor(example):
        return array
    return sys.modules["torch"].from_numpy(array).to(example.device)


def read_observation(
    obs: Mapping[str, Any], specs: Mapping[str, ObservationSpec], others: bool = False
) -> tuple[dict[str, Array], Any]:
    """The arrays of an observation by key, each taken from the mapping once: it may give something else the next time.

    Args:
        others: leave keys alone that are not the policy's, rather than refuse them.

    Returns:
        The arrays, not checked but for images that the policy resizes, which are; and the first of them that came as a
        tensor, as it came, or None.
    """
    if not isinstance(obs, Mapping):
        expected = f"a dictionary with the keys {sorted(specs)}"
        raise ObservationError(f"the observation is a {type(obs).__name__}; expected {expected}.")
    given = {key: value for key in specs if (value := obs.get(key, _MISSING)) is not _MISSING}
    if len(given) < len(specs) or (not others and len(obs) != len(specs)):
        missing, unexpected = specs.keys() - given.keys(), obs.keys() - specs.keys()
        names = [sorted(map(str, each))[:20] for each in (obs, missing, unexpected)]
        found = "{:.400} (missing: {:.400}, unexpected: {:.400})".format(*map(str, names))
        remedy = "Give exactly the keys that the policy was compiled for."
        if "task" in unexpected and any(specs[key].dtype == "int64" for key in missing):
            loaded = "the artifact has no tokenizer: load with tokenizer=PATH (serve: --tokenizer)"
            remedy = f"For a text in place of its tokens, {loaded}, or compile it in: convert --task."
        raise ObservationError(f"expected the observation keys {sorted(specs)}; found {found}. {remedy}")
    example = next((value for value in given.values() if is_tensor(value)), None)
    arrays = {}
    for key, value in given.items():
        what, spec = f"observation {key!r}", specs[key]
        arrays[key] = fitted(plain(value, what, ObservationError, spec.dtype), spec, what)
    return arrays, example


def check_observation(arrays: Arrays, specs: Mapping[str, ObservationSpec]) -> dict[str, Array]:
    """Copies of arrays ``[B, ...]`` of their specified shapes and dtypes, with numbers that can be, and one B.

    They are copied before their numbers are looked at: another thread may write into the caller's.
    """
    own = {}
    for key, spec in specs.items():
        _check_kind(key, arrays[key], spec)
        own[key] = arrays[key].copy()
        check_values(own[key], spec, f"observation {key!r}", ObservationError)
    counts = {key: len(array) for key, array in own.items()}
    if len(set(counts.values())) > 1:
        differ = f"observations hold different numbers of streams: {counts}"
        raise ObservationError(f"{differ}. The first axis of all must be the same.")
    return own


def _check_kind(key: str, array: Array, spec: ObservationSpec) -> None:
    wrong = "shape" if array.shape[1:] != spec.shape or len(array) < 1 else "dtype"
    if wrong == "dtype" and array.dtype == spec.dtype:
        return
    convert = f" Convert it with .astype(np.{spec.dtype}), after making sure that its units are those of training."
    remedy = image_remedy(array, spec) or (convert if wrong == "dtype" else _frames_remedy(array, spec))
    if array.shape == spec.shape:
        remedy = " A single stream needs a first axis of 1: use obs[None]."
    expected = f"{spec.dtype} [B, {', '.join(map(str, spec.shape))}]; found {array.dtype!s:.80} {list(array.shape)}"
    raise ObservationError(f"observation {key!r} has the wrong {wrong}: expected {expected}.{remedy}")


def _frames_remedy(array: Array, spec: ObservationSpec) -> str:
    """What to do with another number of frames than the key has; nothing for other arrays."""
    if spec.frames and array.shape[1:] != spec.shape and spec.shape[1:] in (array.shape[1:], array.shape[2:]):
        return f" Give the last {spec.frames} frames of each stream; select_action takes the newest alone."
    return " It has no axis of frames here: give the newest alone, [:, -1]." if array.shape[2:] == spec.shape else ""


def image_remedy(array: Array, spec: ObservationSpec) -> str:
    """What to do with an image of bytes, or with its channels last; nothing for other arrays."""
    divide = f" Divide by 255, channels first: image.astype(np.{spec.dtype}) / 255."
    channels = spec.shape[-3] if spec.image and array.ndim > 3 else 0
    last = bool(0 < channels == array.shape[-1] and array.shape[-3] != channels)
    move = " Its channels are last: use np.moveaxis(image, -1, -3)."
    return divide * bool(spec.image and array.dtype.kind in "iu") + move * last


def check_noise(noise: Noise, streams: int, spec: PolicySpec) -> Noise:
    """The noise of a call as float32 arrays that fit it, copies of the caller's.

    Args:
        noise: the caller's; where the policy predicts fewer steps than the original, with as many as either. If the
            sampler draws no noise in its steps, ``noise.steps`` is not looked at; of those of a longer loop the first
            K are taken.

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
    steps = plain(noise.steps, "noise.steps", ObservationError)
    if steps.ndim and len(steps) > shape[0]:
        steps = steps[: shape[0]]  # that of a longer loop, so that plans of several loops can have the same
    return Noise(initial, _noise(steps, "noise.steps", "[K, B, T, D]", shape, spec.left_out))


def _noise(value: Any, what: str, axes: str, shape: tuple[int, ...], left_out: int) -> FloatArray:
    array = plain(value, what, ObservationError)
    if left_out and array.shape == (*shape[:-2], shape[-2] + left_out, shape[-1]):
        array = array[..., : shape[-2], :]
    if array.shape != shape or array.dtype != np.float32:
        expected = f"float32 {axes} = {list(shape)}; found {array.dtype} {list(array.shape)}"
        raise ObservationError(f"{what} must be {expected}. Use rng.standard_normal(shape, dtype=np.float32).")
    own: FloatArray = array.copy()
    check_numbers(own, None, what, "Draw it again.", ObservationError)
    return own
