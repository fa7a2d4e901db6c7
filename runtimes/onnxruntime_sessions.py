"""Sessions of onnxruntime for the pieces of an artifact, on one thread pool for the whole process.

A session for each block is only affordable if they share their threads: 25 spinning pools made a call ten times
slower than one. onnxruntime has one global pool a process, whose size is set once, and from then on it refuses every
session that wants threads of its own, other code's included. One thread needs no pool.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ttscompile.errors import ArtifactError, RuntimeUnavailableError

if TYPE_CHECKING:
    from ttscompile.artifact.load import Artifact

Array: TypeAlias = npt.NDArray[Any]


class _Pool:
    """What this module knows about onnxruntime's global thread pool: a fact of the process, not of a policy."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads: int | None = None

    def ensure(self, ort: Any, threads: int) -> None:
        """See that sessions will run on this many threads: make the pool if it takes one and there is none.

        Raises:
            RuntimeUnavailableError: there is a pool of another size, which cannot be changed.
        """
        with self._lock:
            if threads > 1 and self._threads is None:
                try:
                    ort.set_global_thread_pool_sizes(threads, 1)
                except Exception as error:  # its class Fail is derived from Exception
                    raise foreign_pool(threads) from error
                self._threads = threads
            if self._threads not in (None, threads):
                raise RuntimeUnavailableError(
                    f"threads={threads} was asked for, but this process has a pool of {self._threads} threads, made"
                    " for the first policy with more than one. onnxruntime cannot change its size, and with it every"
                    f" session has to use it. Use threads={self._threads}, or load policies with threads=1 before the"
                    " others, or use another process."
                )


def foreign_pool(threads: int) -> RuntimeUnavailableError:
    """The error of a process whose pool was made by somebody else."""
    return RuntimeUnavailableError(
        f"threads={threads} was asked for, but other code of this process has made onnxruntime's global thread pool,"
        " whose size is unknown and cannot be changed. Load the policy before that code runs, or in another process."
    )


_POOL = _Pool()


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

    With one thread a session runs on the caller's thread and needs no pool. With more, all share the global pool, whose
    idle workers spin for some tens of milliseconds after a run before they sleep: onnxruntime 1.31 offers no way to
    change that from Python.

    Raises:
        RuntimeUnavailableError: onnxruntime is missing, or the thread pool has another size.
        ArtifactError: onnxruntime refuses a graph.
    """
    ort = import_onnxruntime()
    _POOL.ensure(ort, threads)
    options = ort.SessionOptions()
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    if threads == 1:
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
    else:
        options.use_per_session_threads = False
    sessions = {}
    for piece in artifact.manifest.pieces:
        path = artifact.onnx_path(piece)
        try:
            sessions[piece] = ort.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
        except Exception as error:  # onnxruntime's own classes are derived from Exception
            if "global thread pool" in str(error):
                raise foreign_pool(threads) from error
            raise ArtifactError(
                f"{path}: onnxruntime {ort.__version__} cannot load this graph: {error} Install the version that the"
                f" artifact asks for (>= {artifact.manifest.requires.onnxruntime}), or convert the checkpoint again."
            ) from error
    return sessions


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
