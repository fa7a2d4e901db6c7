"""The records of ``config`` and ``ir`` that a manifest holds, to JSON and strictly back.

Floats are written as the shortest decimal of the double that equals the float32, so that they come back bit by bit.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.spec import Affine, ChunkSpec, FloatArray, ObservationSpec, PolicySpec, SamplerTable
from ..errors import ArtifactError, SpecError
from ..ir.graph import Batch, Size, TensorType
from .strict_json import REMEDY, Value

DTYPES = ("float32", "float64", "float16", "int64", "int32", "int16", "int8", "uint8", "bool")
_BATCH = re.compile(r"(?:([1-9][0-9]{0,8})\*)?B")


def type_to_json(kind: TensorType) -> dict[str, Any]:
    """``float32[B, 16, 64]`` as ``{"dtype": "float32", "shape": ["B", 16, 64]}``."""
    return {"dtype": kind.dtype, "shape": [str(n) if isinstance(n, Batch) else n for n in kind.shape]}


def type_from_json(value: Value) -> TensorType:
    """Inverse of ``type_to_json``.

    Raises:
        ArtifactError: not a tensor type.
    """
    fields = value.keys("dtype", "shape")
    return TensorType(tuple(_size(item) for item in fields["shape"].items()), fields["dtype"].text(*DTYPES))


def spec_to_json(spec: PolicySpec) -> dict[str, Any]:
    """A ``PolicySpec`` as JSON; the order of the observations is kept."""
    # Only where it says something, so that an artifact of the whole horizon is what it was before there was a choice.
    narrowed = {"left_out": spec.left_out} if spec.left_out else {}
    return {
        "sample": list(spec.sample),
        "sample_argument": spec.sample_argument,
        "timestep_argument": spec.timestep_argument,
        "observations": {
            key: {
                "shape": list(o.shape),
                "dtype": o.dtype,
                "normalizer": _affine_to_json(o.normalizer),
                "window": o.window,
                "bounds": _bounds_to_json(o),
            }
            for key, o in spec.observations.items()
        },
        "chunk": {
            "action_dim": spec.chunk.action_dim,
            "start": spec.chunk.start,
            "stop": spec.chunk.stop,
            "normalizer": _affine_to_json(spec.chunk.normalizer),
            "ranged": spec.chunk.ranged,
        },
        "sampler": _sampler_to_json(spec.sampler),
        "source": {key: spec.source[key] for key in sorted(spec.source)},
        **narrowed,
    }


def spec_from_json(value: Value) -> PolicySpec:
    """Inverse of ``spec_to_json``.

    Raises:
        ArtifactError: not a specification, or one that contradicts itself.
    """
    names = ("sample", "sample_argument", "timestep_argument", "observations", "chunk", "sampler", "source")
    fields = value.keys(*names, optional=("left_out",))
    sample = [item.integer(1) for item in fields["sample"].items()]
    if len(sample) != 2:
        fields["sample"].fail("two sizes [T, D]")
    chunk = fields["chunk"].keys("action_dim", "start", "stop", "normalizer", "ranged")
    try:
        return PolicySpec(
            sample=(sample[0], sample[1]),
            observations={key: _observation(item) for key, item in fields["observations"].members().items()},
            sampler=_sampler(fields["sampler"]),
            chunk=ChunkSpec(
                action_dim=chunk["action_dim"].integer(),
                start=chunk["start"].integer(),
                stop=chunk["stop"].integer(),
                normalizer=_affine(chunk["normalizer"]),
                ranged=chunk["ranged"].boolean(),
            ),
            sample_argument=fields["sample_argument"].text(),
            timestep_argument=fields["timestep_argument"].text(),
            source={key: item.text() for key, item in fields["source"].members().items()},
            left_out=fields["left_out"].integer() if "left_out" in fields else 0,
        )
    except SpecError as error:
        raise ArtifactError(f"{value.path}: {error} {REMEDY}") from error


def floats(value: Value) -> FloatArray:
    """A list of numbers as float32 ``[n]``, exactly.

    Raises:
        ArtifactError: not such a list, or a number that is no float32.
    """
    numbers = []
    for item in value.items():
        number = item.number()
        with np.errstate(over="ignore"):
            if float(np.float32(number)) != number:
                item.fail("a number that float32 holds exactly")
        numbers.append(number)
    return np.array(numbers, dtype=np.float32)


def floats_to_json(array: npt.NDArray[np.float32]) -> list[float]:
    """A float32 vector as JSON numbers that ``floats`` reads back bit by bit."""
    return [float(x) for x in array]


def _size(value: Value) -> Size:
    if isinstance(value.data, str):
        match = _BATCH.fullmatch(value.data)
        if match is None or match[1] == "1":
            value.fail("a size: an integer, 'B' or 'n*B'")
        return Batch(int(match[1] or 1))
    return value.integer()


def _affine_to_json(affine: Affine | None) -> dict[str, Any] | None:
    if affine is None:
        return None
    return {"scale": floats_to_json(affine.scale), "offset": floats_to_json(affine.offset)}


def _affine(value: Value) -> Affine | None:
    if value.absent:
        return None
    fields = value.keys("scale", "offset")
    try:
        return Affine(scale=floats(fields["scale"]), offset=floats(fields["offset"]))
    except SpecError as error:
        raise ArtifactError(f"{value.path}: {error} {REMEDY}") from error


def _bounds_to_json(observation: ObservationSpec) -> list[list[float]] | None:
    """Low and high as rows; ``ObservationSpec`` keeps tuples."""
    return None if observation.bounds is None else [np.atleast_1d(each).tolist() for each in observation.bounds]


def _observation(value: Value) -> ObservationSpec:
    fields = value.keys("shape", "dtype", "normalizer", "window", "bounds")
    bounds = None
    if not fields["bounds"].absent:
        bounds = [tuple(item.number() for item in row.items()) for row in fields["bounds"].items()]
        if len(bounds) != 2:
            fields["bounds"].fail("two rows of numbers, low and high, or null")
    return ObservationSpec(
        shape=tuple(item.integer(1) for item in fields["shape"].items()),
        normalizer=_affine(fields["normalizer"]),
        dtype=fields["dtype"].text(*DTYPES),
        window=fields["window"].boolean(),
        bounds=None if bounds is None else (bounds[0], bounds[1]),
    )


def _sampler_to_json(sampler: SamplerTable) -> dict[str, Any]:
    return {
        "name": sampler.name,
        "clip": None if sampler.clip is None else float(sampler.clip),
        "timesteps": {"dtype": str(sampler.timesteps.dtype), "values": sampler.timesteps.tolist()},
        **{name: floats_to_json(getattr(sampler, name)) for name in SamplerTable.COLUMNS},
        "memory": {
            "count": sampler.memories,
            "to_next": floats_to_json(sampler.memory_to_next.ravel()),
            "to_memory": floats_to_json(sampler.to_memory.ravel()),
        },
    }


def _sampler(value: Value) -> SamplerTable:
    fields = value.keys("name", "clip", "timesteps", *SamplerTable.COLUMNS, "memory")
    timesteps = fields["timesteps"].keys("dtype", "values")
    if timesteps["dtype"].text("int64", "float32") == "int64":
        steps: npt.NDArray[Any] = np.array([item.integer(None) for item in timesteps["values"].items()], np.int64)
    else:
        steps = floats(timesteps["values"])
    columns = {name: floats(fields[name]) for name in SamplerTable.COLUMNS}
    clip = None if fields["clip"].absent else fields["clip"].number()
    memory = fields["memory"].keys("count", "to_next", "to_memory")
    count = memory["count"].integer()
    return SamplerTable(
        name=fields["name"].text(),
        timesteps=steps,
        clip=clip,
        memory_to_next=_shaped(memory["to_next"], (len(steps), count)),
        to_memory=_shaped(memory["to_memory"], (len(steps), count, 3 + count)),
        **columns,
    )


def _shaped(value: Value, shape: tuple[int, ...]) -> FloatArray:
    """A flat list of float32 numbers as an array of this shape."""
    numbers = floats(value)
    if numbers.size != math.prod(shape):
        value.fail(f"{math.prod(shape)} numbers, for the shape {list(shape)}")
    return numbers.reshape(shape)
