"""Sessions of onnxruntime for the pieces of an artifact; their threads sleep when there is nothing to do.

onnxruntime's global thread pool would be shared by all sessions, but it is a fact of the process: once made, its size
cannot change, its workers spin, and every other session of the process that wants threads of its own is refused. A
robot runs other things beside the policy. So threads belong to sessions.

Steps that compute all blocks run in one session, at any number of threads. Single blocks are in sessions of their own
with one thread, the caller's. With more, one session holds all of them (``ir.pieces``). Threads of a session,
``threads - 1`` each, stay awake from one operation to the next: they look for work for ``SPIN_US`` after each, and then
sleep. Between calls nothing runs. ``docs/decisions.md`` has the figures.

A session keeps its weights as its products read them, so sessions of single blocks, which most calibrated plans do not
need, are opened when some plan does. Whatever runs a graph raises an ``ArtifactError`` where that does not do what the
manifest says.
"""

import ctypes
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakSet

import numpy as np

from ttscompile.artifact.files import read_file
from ttscompile.artifact.manifest import PieceRecord
from ttscompile.artifact.tensors import MAPPED
from ttscompile.artifact.view import View
from ttscompile.core.coercion import Array, Arrays
from ttscompile.core.spec import FP32
from ttscompile.errors import ArtifactError, RuntimeUnavailableError
from ttscompile.ir import pieces as kinds
from ttscompile.ir.graph import TensorType
from ttscompile.ir.pieces import Joint, join
from ttscompile.measure.machine import has_integer_dot_product
from ttscompile.measure.versions import release
from ttscompile.runtimes.contexts import ContextValues
from ttscompile.runtimes.tokens import Kept, reusing

SINGLE_THREADED = frozenset({kinds.STEM, kinds.ADVANCE, kinds.PRUNER, kinds.IDLE})
"""Pieces too small for a second thread."""

FIRST_STEP = "first_step"
"""Name of the session that computes step 0: that of ``dense_step``, but for a plan with weights of its own."""

SPIN_US = 50
"""How long a thread of a session looks for work before it sleeps: longer than what lies between most blocks of a step,
shorter than the end of a call. Push-T at 4 threads: 38.7 ms a call with 0, 27.7 with 50, 27.2 with 1000; and
the processor time that threads take after the call: none, none, 20 ms; 94 ms with onnxruntime's own setting. An image
encoder of SmolVLA in int8 on two threads: 223 ms with 0, 207 with 50, 204 with 1000."""

TIMED = (1, 26)
"""The first onnxruntime that can be told how long. Threads of an older one sleep at once."""

EXACT_INTEGERS = "session.x64quantprecision"
"""Option of onnxruntime's sessions: sum products of integers exactly, slower than in fp32, rather than in 16 bits that
saturate. It takes processors with VNNI for such that saturate, and costs them their speed; so it is only set where it
is needed."""

CONFIG_FROM_MODEL = "ORT_LOAD_CONFIG_FROM_MODEL"
"""Environment variable of onnxruntime. With it a session has the options that its model has; if that has none, then
those of onnxruntime, with a thread a core. No argument turns it off."""


class Sessions:
    """The sessions of one artifact's models; views that compute with the same model share its session."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._known: dict[tuple[str, int], Any] = {}
        self._careful: dict[str, bool] = {}

    def of(self, view: View, blocks: bool = True) -> dict[str, Any]:
        """What runs each ONNX piece, by name, an ``InferenceSession`` or a ``JointBlock``; of ``blocks`` if asked.

        Raises:
            RuntimeUnavailableError: onnxruntime is missing, other code has made its global thread pool, or the
                environment has it ignore options.
            ArtifactError: onnxruntime refuses a graph.
        """
        manifest = view.manifest
        single = {kinds.block_name(b) for b in range(len(manifest.blocks))}
        # A piece that reuses tokens computes all of them with the same session, so that its weights are there once.
        own = reusing(manifest, view.variant.tokens)
        beside = {make(name) for name in own for make in (kinds.pixels_name, kinds.tokens_name)}
        unused = {*own, *filter(kinds.of_tokens, manifest.pieces)} - beside
        others = set(filter(kinds.is_of_loop, manifest.pieces))
        others |= {name for name, piece in manifest.pieces.items() if not piece.outputs}  # nothing is left to compute
        once = set(manifest.pieces) - single - {kinds.JOINT, kinds.LAYERS} - set(unused) - others
        contents = _contents(view)
        sessions = {piece: self._session(view, piece, contents) for piece in sorted(once)}
        sessions[FIRST_STEP] = self._session(view, kinds.DENSE_STEP, contents, first_step=True)
        return sessions | self._of_blocks(view, contents) if blocks else sessions

    def of_blocks(self, view: View) -> dict[str, Any]:
        """What runs single blocks, by name, some time after the artifact was loaded.

        Raises:
            ArtifactError: the artifact on disk is no longer the one that was loaded, or onnxruntime refuses a graph.
        """
        with view.artifact.reading():
            return self._of_blocks(view, _contents(view))

    def of_layers(self, view: View) -> dict[str, Any]:
        """What runs the piece ``layers``, by its name, some time after the artifact was loaded; for ``verify``."""
        with view.artifact.reading():
            return {kinds.LAYERS: self._session(view, kinds.LAYERS, _contents(view))}

    def _of_blocks(self, view: View, contents: Mapping[str, bytes]) -> dict[str, Any]:
        manifest = view.manifest
        names = [kinds.block_name(b) for b in range(len(manifest.blocks))]
        if self.threads == 1:
            return {name: self._session(view, name, contents) for name in names}
        session, blanks = self._session(view, kinds.JOINT, contents), dict[int, dict[str, Array]]()
        pieces = [manifest.pieces[name] for name in names]
        joint = join([tuple(manifest.contexts[name].type for name in piece.contexts) for piece in pieces])
        return {
            name: JointBlock(session, joint, b, piece, manifest.blocks[b].type, blanks)
            for b, (name, piece) in enumerate(zip(names, pieces, strict=True))
        }

    def _session(self, view: View, piece: str, contents: Mapping[str, bytes], first_step: bool = False) -> Any:
        file = view.onnx_file(piece, first_step)
        threads = 1 if piece in SINGLE_THREADED else self.threads
        if (file, threads) not in self._known:
            precision = view.precision.get(str(kinds.part_of(piece)), FP32)
            if precision not in self._careful:
                self._careful[precision] = needs_care(precision)
            self._known[file, threads] = _open_file(view, file, threads, self._careful[precision], contents)
        return self._known[file, threads]


def _contents(view: View) -> dict[str, bytes]:
    """All files with weights if they are small, or none: what onnxruntime is given in memory it does not map.

    A session copies what it needs of them when it is opened.
    """
    there = view.artifact.present
    sizes = {n: record.bytes for n, record in view.manifest.acting.items() if n in there and n.endswith(".safetensors")}
    small = sum(sizes.values()) < MAPPED
    return {name: read_file(view.artifact.files / name, size) for name, size in sizes.items()} if small else {}


def _open_file(view: View, file: str, threads: int, careful: bool, contents: Mapping[str, bytes]) -> Any:
    try:
        import onnxruntime as ort
    except ImportError as error:
        problem = f"runtime 'onnxruntime' needs the package onnxruntime, which cannot be imported ({error})."
        raise RuntimeUnavailableError(f"{problem} Run: pip install onnxruntime.") from error
    if os.environ.get(CONFIG_FROM_MODEL) not in (None, "", "0"):
        problem = f"the environment variable {CONFIG_FROM_MODEL} has onnxruntime ignore the threads and options that"
        raise RuntimeUnavailableError(f"{problem} a policy is loaded with. Unset it.")
    path, options = view.artifact.files / file, _options(ort, threads, careful)
    if contents and (give := getattr(options, "add_external_initializers_from_files_in_memory", None)):  # from 1.24 on
        give(list(contents), list(contents.values()), [len(content) for content in contents.values()])
    try:
        session = ort.InferenceSession(str(path), options, ["CPUExecutionProvider"], enable_fallback=0)
    except Exception as error:  # onnxruntime's own classes are derived from Exception
        if "global thread pool" in str(error):
            raise RuntimeUnavailableError(
                "other code of this process has made onnxruntime's global thread pool, and with it onnxruntime"
                " refuses sessions with threads of their own. Load the policy in another process."
            ) from error
        if "escapes model directory" in str(error):
            problem = "a file beside it is a link that leads out of the artifact's folder"
            raise ArtifactError(f"{path}: {problem}. Put the file there: cp -L.") from error
        raise ArtifactError(
            f"{path}: onnxruntime {ort.__version__} cannot load this graph: {error} Install the version that the"
            f" artifact asks for (>= {view.manifest.requires.onnxruntime}), or convert the checkpoint again."
        ) from error
    if threads > 1:
        _threaded.add(session)
    return session


def _options(ort: Any, threads: int, careful: bool) -> Any:
    options = ort.SessionOptions()
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    if release(ort.__version__) >= TIMED:
        options.add_session_config_entry("session.intra_op.spin_duration_us", str(SPIN_US))
    else:  # it would look for work for tens of milliseconds, and take the processor from everything else
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if careful:
        options.add_session_config_entry(EXACT_INTEGERS, "1")
    return options


def needs_care(precision: str) -> bool:
    """Whether sessions need ``EXACT_INTEGERS`` for blocks of this precision to be right; warns that they are slow."""
    if precision == FP32 or (found := has_integer_dot_product()):
        return False
    what = "nothing that says what this one has" if found is None else "one without them"
    warnings.warn(
        f"precision {precision!r} is fast on a processor with integer dot products (on x86 avx512_vnni, avx_vnni or"
        f" amx_int8 among the flags in /proc/cpuinfo); found {what}. The actions are right, and gain less time: compare"
        " with a plan in fp32 (ttscompile bench), and take that where it is faster (NAME@fp32).",
        stacklevel=2,
    )
    return True


_threaded: WeakSet[Any] = WeakSet()
"""The sessions with threads of their own."""


def _keep_for_ever() -> None:
    """In a forked child: keep what was inherited, whoever lets go of it.

    A session ends by waiting for its threads, which are not in the child: it would wait for ever, or crash.
    """
    for session in _threaded:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(session))


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_keep_for_ever)

_TURNS = (np.array(False), np.array(True))


@dataclass(frozen=True)
class JointBlock:
    """One block of the session of the piece ``blocks``; takes and gives what the block's own session would.

    For contexts that it does not read there are zeros, by number of streams.
    """

    session: Any
    joint: Joint
    index: int
    piece: PieceRecord
    stream: TensorType
    blanks: dict[int, dict[str, Array]]

    def feeds(self, inputs: Arrays) -> dict[str, Array]:
        """The inputs of the joint session for the inputs of the block; those that it does not read are zeros."""
        assert self.piece.stream is not None
        stream, turns = inputs[self.piece.stream], self.joint.turns[self.index]
        axis = self.stream.batch_axis
        streams = 1 if axis is None else stream.shape[axis]
        if streams not in self.blanks:
            self.blanks[streams] = {name: np.zeros(type_.at(streams), type_.dtype) for name, type_ in self.joint.slots}
        places = zip(self.piece.contexts, self.joint.places[self.index], strict=True)
        return {
            **{name: _TURNS[turn] for name, turn in zip(self.joint.switches, turns, strict=True)},
            kinds.STREAM: stream,
            **self.blanks[streams],
            **{slot: inputs[name] for name, slot in places},
        }


class Bound:
    """A session tied to arrays that stay where they are: running it reads some and writes the others.

    Binding costs as much as several runs' overhead, and saves it in every run; so bindings are made once and kept.
    """

    __slots__ = ("_arrays", "_binding", "_session")

    def __init__(self, session: Any, inputs: Arrays, outputs: Arrays) -> None:
        if isinstance(session, JointBlock):
            (residual,) = outputs.values()
            session, inputs, outputs = session.session, session.feeds(inputs), {kinds.RESIDUAL: residual}
        self._arrays = (*inputs.values(), *outputs.values())  # the binding holds bare addresses
        assert all(array.flags.c_contiguous for array in self._arrays)
        self._session, self._binding = session, session.io_binding()
        for bind, arrays in ((self._binding.bind_input, inputs), (self._binding.bind_output, outputs)):
            for name, array in arrays.items():
                bind(name, "cpu", 0, array.dtype.type, array.shape, array.ctypes.data)

    def run(self) -> None:
        """Run once. Raises ArtifactError: the graph does not do what the manifest says."""
        try:
            self._session.run_with_iobinding(self._binding)
        except Exception as error:  # onnxruntime's own classes, and what it raises itself
            raise _failed(error) from error


def run_named(session: Any, outputs: Sequence[str], inputs: Arrays) -> dict[str, Array]:
    """Run a session on arrays of the moment; its outputs by name."""
    try:
        return dict(zip(outputs, session.run(list(outputs), dict(inputs)), strict=True))
    except Exception as error:
        raise _failed(error) from error


def run_piece(
    sessions: Mapping[str, Any], pieces: Mapping[str, PieceRecord], name: str, inputs: Arrays
) -> tuple[Array, ...]:
    """Run a piece on arrays of the moment, outputs in order: for ``frames``, which must not hold on to a backend."""
    return tuple(run_named(sessions[name], pieces[name].outputs, inputs).values())


_DTYPES = {"tensor(float)": np.float32, "tensor(int64)": np.int64, "tensor(bool)": np.bool_}
"""Of what a piece for some tokens gives, by onnxruntime's name."""


def renew_piece(sessions: Mapping[str, Any], name: str, inputs: Arrays, kept: Kept) -> tuple[Array, ...]:
    """Run a piece for some tokens: what is kept gets its new rows where it is. Its other outputs, in order.

    A ScatterND whose output is bound to the memory that it reads writes the new rows and nothing else. What is bound
    stays so, for each number of tokens: to bind takes as long as a layer of a small encoder.

    Raises:
        ArtifactError: the graph does not do what the manifest says. What is kept may have some of the new rows.
    """
    session, size, share = sessions[name], tuple(map(len, inputs.values())), kept.shared.setdefault
    try:
        if size not in kept.bound:
            own = {key: np.empty_like(array) for key, array in inputs.items()}
            own[kinds.PIXELS] = share(kinds.PIXELS, own[kinds.PIXELS])
            into = {kinds.renewed_name(key): array for key, array in kept.arrays.items()}
            others = [one for one in session.get_outputs() if one.name not in into]
            made = {one.name: share(one.name, np.zeros(one.shape, _DTYPES[one.type])) for one in others}
            kept.bound[size] = own, made, Bound(session, {**own, **kept.arrays}, {**made, **into})
    except Exception as error:  # onnxruntime's own classes, and what it raises itself
        raise _failed(error) from error
    own, made, bound = kept.bound[size]
    for key, array in inputs.items():
        own[key][...] = array
    bound.run()
    return tuple(array.copy() for array in made.values())


def _failed(error: Exception) -> ArtifactError:
    return ArtifactError(
        f"onnxruntime cannot run a graph of the artifact: {str(error).strip()[:500]} The graph does not fit the"
        " manifest, or there is too little memory. Convert the checkpoint again."
    )


def run_prologue(
    sessions: Mapping[str, Any], pieces: Mapping[str, PieceRecord], obs: Arrays, contexts: ContextValues
) -> None:
    """Keep what the normalised observations ``[B, ...]`` decide before the loop."""
    condition, step = pieces[kinds.CONDITION], pieces.get(kinds.STEP)
    if kinds.SCENE in pieces:
        contexts.keep((name, obs[name]) for name in pieces[kinds.SCENE].outputs)
    if condition.outputs:
        feed = {name: np.ascontiguousarray(obs[name]) for name in condition.inputs}
        contexts.keep(run_named(sessions[kinds.CONDITION], condition.outputs, feed).items())
    if step is not None:
        feed = dict(zip(step.inputs, contexts.for_step_piece(step.inputs), strict=True))
        contexts.keep_steps(run_named(sessions[kinds.STEP], step.outputs, feed).items())
