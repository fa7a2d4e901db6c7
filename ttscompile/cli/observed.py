"""One observation from the words of a command line: pictures, a state, or an archive of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import ObservationError, RuntimeUnavailableError
from ttscompile.trajectories.episodes import read_npz

Array = npt.NDArray[Any]


def observed(
    specs: Mapping[str, ObservationSpec], pictures: Mapping[str, Path], state: Array | None, archive: Path | None
) -> tuple[dict[str, Array], list[str]]:
    """The observation as ``predict_action`` takes it, one stream; and the keys of which one frame fills the window.

    Pictures are by the key of a camera, or the end of it; the archive is an ``.npz`` with arrays by key.

    Raises:
        ObservationError: a name or a picture that does not fit, or a key twice.
        TrajectoryError: the archive cannot be read.
    """
    given = {} if archive is None else read_npz(archive)
    more = [(_camera(name, specs), name, path) for name, path in pictures.items()]
    parts = [(key, _picture(path, specs[key], f"--image {name}={path}")) for key, name, path in more]
    if state is not None:
        vectors = [key for key, one in specs.items() if not one.image and np.dtype(one.dtype).kind == "f"]
        named = [key for key in vectors if key.rpartition(".")[2] == "state"] or vectors
        if len(named) != 1:
            told = f"--state is for the one vector of a policy; this one reads {', '.join(vectors) or 'none'}"
            raise ObservationError(f"{told}. Give all in an archive: --observation FILE.npz.")
        parts.append((named[0], state))
    for key, array in parts:
        if key in given:
            raise ObservationError(f"{key} is given twice. Leave out one picture, --state, or the array in {archive}.")
        given[key] = array
    whole = {key: _window(array, specs[key]) if key in specs else (array, False) for key, array in given.items()}
    return {key: array for key, (array, _) in whole.items()}, [key for key, (_, one) in whole.items() if one]


def _camera(name: str, specs: Mapping[str, ObservationSpec]) -> str:
    cameras = [key for key, one in specs.items() if one.image]
    found = [key for key in cameras if key == name] or [key for key in cameras if key.endswith(f".{name}")]
    if len(found) != 1:
        told = f"--image {name}: {'several cameras have' if found else 'no camera has'} this name"
        raise ObservationError(f"{told}; expected one of {', '.join(cameras) or 'none: it reads no pictures'}.")
    return found[0]


def _picture(path: Path, spec: ObservationSpec, what: str) -> Array:
    """A PNG or JPEG as float32 ``[C, H, W]`` in 0..1."""
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        remedy = "Run: pip install 'ttscompile[compile]', or give arrays with --observation FILE.npz."
        raise RuntimeUnavailableError(f"{what}: pictures need Pillow, which is not installed. {remedy}") from error
    channels, height, width = spec.shape[-3:]
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            size = image.size
            array = np.asarray(image.convert("L" if channels == 1 else "RGB"), np.float32) / 255
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ObservationError(f"{what}: expected a picture in PNG or JPEG; {error!s:.200}.") from error
    if spec.fit is None and size != (width, height):
        told = f"{what}: expected {width}x{height} pixels, as in training; found {size[0]}x{size[1]}"
        raise ObservationError(f"{told}. Resize or crop it as the training data was.")
    return np.moveaxis(array.reshape(*array.shape[:2], channels), -1, 0)


def _window(array: Array, spec: ObservationSpec) -> tuple[Array, bool]:
    """A frame or a window as ``[1, *shape]``, and whether one frame fills it; the policy refuses other shapes."""
    with np.errstate(over="ignore"):  # infinity is refused
        array = array.astype(spec.dtype) if array.dtype.kind == "f" else array
    if array.ndim == 1 and array.size == np.prod(spec.shape):
        array = array.reshape(spec.shape)
    repeated = array.ndim < len(spec.shape)
    if repeated and spec.frames is not None:
        array = np.repeat(array[None], spec.frames, 0)
    return array if array.ndim > len(spec.shape) else array[None], repeated and (spec.frames or 1) > 1
