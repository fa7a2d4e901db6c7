"""Sessions of onnxruntime for the pieces of an artifact; their threads sleep when there is nothing to do.

onnxruntime's global thread pool would be shared by all sessions, but it is a fact of the process: once made, its size
cannot change, its workers spin, and every other session of the process that wants threads of its own is refused. A
robot runs other things beside the policy. So each session has its own threads, which do not spin;
``docs/decisions.md`` has what that costs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ttscompile.errors import ArtifactError, RuntimeUnavailableError

if TYPE_CHECKING:
    from ttscompile.artifact.load import Artifact

Array: TypeAlias = npt.NDArray[Any]


SINGLE_THREADED = frozenset({"stem", "advance", "pruner"})
"""Pieces too small for a second thread."""


def import_onnxruntime() -> Any:
    """The module ``onnxruntime``.

    Raises:
        RuntimeUnavailableError: it is not installed, or does not load.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise RuntimeUnavailableError(
            f"runtime 'onnxruntime' needs the package onnxruntime, which cannot be imported ({error})."
            " Run: pip install onnxruntime."
        ) from error
    return onnxruntime


def open_sessions(artifact: Artifact, threads: int) -> dict[str, Any]:
    """An ``InferenceSession`` for each ONNX piece of the artifact, by name.

    With one thread a session runs on the caller's thread and makes none.

    Raises:
        RuntimeUnavailableError: onnxruntime is missing, or other code has made its global thread pool.
        ArtifactError: onnxruntime refuses a graph.
    """
    ort = import_onnxruntime()
    sessions = {}
    for piece in artifact.manifest.pieces:
        path = artifact.onnx_path(piece)
        options = _options(ort, 1 if piece in SINGLE_THREADED else threads)
        try:
            sessions[piece] = ort.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
        except Exception as error:  # onnxruntime's own classes are derived from Exception
            if "global thread pool" in str(error):
                raise RuntimeUnavailableError(
                    "other code of this process has made onnxruntime's global thread pool, and with it onnxruntime"
                    " refuses sessions with threads of their own. Load the policy in another process."
                ) from error
            raise ArtifactError(
                f"{path}: onnxruntime {ort.__version__} cannot load this graph: {error} Install the version that the"
                f" artifact asks for (>= {artifact.manifest.requires.onnxruntime}), or convert the checkpoint again."
            ) from error
    return sessions


def _options(ort: Any, threads: int) -> Any:
    options = ort.SessionOptions()
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Twenty-odd pools that spin made a call ten times slower, and would take the processor from everything else.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return options


class Bound:
    """A session tied to arrays that stay where they are: running it reads some and writes the others.

    Binding costs as much as several runs' overhead, and saves it in every run; so bindings are made once and kept.

    Args:
        session: an ``InferenceSession``.
        inputs: by name; contiguous.
        outputs: by name; contiguous.
    """

    __slots__ = ("_arrays", "_binding", "_session")

    def __init__(self, session: Any, inputs: Mapping[str, Array], outputs: Mapping[str, Array]) -> None:
        self._arrays = (*inputs.values(), *outputs.values())  # the binding holds bare addresses
        assert all(array.flags.c_contiguous for array in self._arrays)
        self._session = session
        self._binding = session.io_binding()
        for name, array in inputs.items():
            self._binding.bind_input(name, "cpu", 0, array.dtype.type, array.shape, array.ctypes.data)
        for name, array in outputs.items():
            self._binding.bind_output(name, "cpu", 0, array.dtype.type, array.shape, array.ctypes.data)

    def run(self) -> None:
        """Run once."""
        self._session.run_with_iobinding(self._binding)


def run_named(session: Any, outputs: Sequence[str], inputs: Mapping[str, Array]) -> dict[str, Array]:
    """Run a session on arrays of the moment; its outputs by name."""
    return dict(zip(outputs, session.run(list(outputs), dict(inputs)), strict=True))


def repeat_streams(array: Array, axis: int | None, streams: int) -> Array:
    """A contiguous copy with an axis of size 1 repeated to the number of streams; no axis, no repetition."""
    return np.ascontiguousarray(array if axis is None else np.repeat(array, streams, axis=axis)).copy()
