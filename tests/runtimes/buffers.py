"""Memory of the onnxruntime runtime's buffers; weights are onnxruntime's."""

import numpy as np

from ttscompile.runtimes import Runtime
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend


def nbytes(kept: object) -> int:
    """Bytes of all arrays that some object of the runtime keeps, the rollout cache included."""
    return sum({id(array): array.nbytes for array in _arrays(kept, set())}.values())


def rollout_nbytes(runtime: Runtime) -> int:
    """Bytes of the rollout cache."""
    assert isinstance(runtime.backend, OnnxBackend)
    assert runtime.backend.workspace is not None
    return sum(entry.nbytes for entry in runtime.backend.workspace.rollout.values())


def _arrays(value: object, seen: set[int]) -> list[np.ndarray]:
    if id(value) in seen:
        return []
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        return [value] if value.base is None else _arrays(value.base, seen)
    if isinstance(value, dict):
        inside = list(value.values())
    elif isinstance(value, list | tuple):
        inside = list(value)
    elif type(value).__module__.startswith("ttscompile.runtimes.onnxruntime"):
        inside = list(getattr(value, "__dict__", {}).values())
    else:
        return []
    return [array for each in inside for array in _arrays(each, seen)]
