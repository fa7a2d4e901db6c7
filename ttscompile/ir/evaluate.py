"""Run a graph with torch: literally, node by node, differentiable.

This is what a graph *means*: passes are tested against it, the reference runtime and calibration run on it, and the
ONNX models are checked against it.
"""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
import torch
import torch.fx.config

from ttscompile.errors import CaptureError, ObservationError

from ..core.coercion import Arrays
from .graph import GETITEM, Argument, Batch, Enum, Graph, Node, Ref, TensorType
from .operations import find_operation, operation

Frame: TypeAlias = list[Any]
Getter: TypeAlias = Callable[[Frame, int], Any]

_ENUM_TYPES = {"dtype": torch.dtype, "memory_format": torch.memory_format, "layout": torch.layout}


def resolve_op(node: Node) -> Callable[..., Any]:
    """The function of a node: a functional ATen overload, or ``operator.getitem``.

    Raises:
        CaptureError: no such operation; one that changes its arguments, draws random numbers or reads files; or one
            that has no row in the table of operations.
    """
    if node.op == GETITEM:
        return operator.getitem
    namespace, _, rest = node.op.partition(".")
    packet_name, _, overload_name = rest.partition(".")
    if namespace != "aten" or not packet_name.isidentifier() or not overload_name.isidentifier():
        raise CaptureError(
            f"operation {node.op!r} of {_where(node)} is not of the form aten.NAME.OVERLOAD."
            " Only ATen operations can be compiled; express custom operators in ATen, or decompose them before export."
        )
    overload = getattr(getattr(torch.ops.aten, packet_name, None), overload_name, None)
    if not isinstance(overload, torch._ops.OpOverload):
        raise CaptureError(
            f"operation {node.op!r} of {_where(node)} does not exist in torch {torch.__version__}."
            " Compile the policy again with this version of torch, or install the version it was compiled with."
        )
    if overload._schema.is_mutable or packet_name == "from_file":  # which reads the machine
        raise CaptureError(
            f"operation {node.op!r} of {_where(node)} is not a pure function of its arguments"
            f" ({overload._schema}). Graphs hold functional operations only: capture the module again."
        )
    if torch.Tag.nondeterministic_seeded in overload.tags and not _dropout_is_off(node):
        raise CaptureError(
            f"operation {node.op!r} of {_where(node)} draws random numbers. All randomness of a policy must come from"
            " its noise argument: call eval() on the module, and remove dropout and sampling inside the denoiser."
        )
    operation(node.op, _where(node))
    return overload


@contextmanager
def without_stack_traces() -> Iterator[None]:
    """While torch traces a graph: it would look up and format Python's stack for every operation.

    torch 2.11 has no such switch: graphs are the same there, and tracing takes longer.
    """
    before = getattr(torch.fx.config, "do_not_emit_stack_traces", None)
    if before is None:
        yield
        return
    torch.fx.config.do_not_emit_stack_traces = True
    try:
        yield
    finally:
        torch.fx.config.do_not_emit_stack_traces = before


def evaluate(
    graph: Graph, weights: Mapping[str, torch.Tensor], inputs: Mapping[str, torch.Tensor]
) -> tuple[torch.Tensor, ...]:
    """Run ``graph`` once; see ``Evaluator`` for shapes, errors, and for running it many times."""
    return Evaluator(graph, weights)(inputs)


def evaluator(graph: Graph, weights: Arrays) -> Evaluator:
    """The graph with its weights, which are read where they are: also where nobody may write, as in an artifact.

    Torch warns of such an array because somebody could write to its tensor. A graph writes to none of its constants.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The given NumPy array is not writable", UserWarning)
        tensors = {name: torch.from_numpy(np.asarray(weights[name])) for name in graph.constants if name in weights}
    return Evaluator(graph, tensors)


class Evaluator:
    """A graph made callable: operations looked up and arguments laid out once.

    The weights are held by reference, not copied: an optimiser's in-place update shows in the next call, and gradients
    flow to them and to the inputs.

    Raises:
        CaptureError: an operation that ``resolve_op`` refuses, an argument that names no value, a constant that is
            missing or does not have its type, or a symbolic size that no input can give a value.
    """

    def __init__(self, graph: Graph, weights: Mapping[str, torch.Tensor], device: torch.device | str = "cpu") -> None:
        self._graph = graph
        self._device = torch.device(device)
        self._bound = any(isinstance(n, Batch) for t in graph.inputs.values() for n in t.shape)
        self._slots = {name: slot for slot, name in enumerate((*graph.inputs, *graph.constants))}
        self._constants = [weights.get(name) for name in graph.constants]
        for (name, type_), value in zip(graph.constants.items(), self._constants, strict=True):
            if value is None:
                raise CaptureError(f"constant %{name} : {type_} of the graph has no value among the weights.")
            if value.dtype != getattr(torch, type_.dtype, None) or tuple(value.shape) != type_.shape:
                raise CaptureError(f"constant %{name} has type {_describe(value)}; the graph expects {type_}.")
        self._steps: list[tuple[Getter, tuple[int, ...]]] = []
        dead = _dead_after(graph)
        for node in graph.nodes:
            call = self._compile(node)
            if node.name in self._slots:
                raise CaptureError(f"two values are called %{node.name}; the second is {_where(node)}.")
            self._slots[node.name] = len(self._slots)
            self._steps.append((call, tuple(self._slots[name] for name in dead[node.name])))
        if missing := [name for name in graph.outputs if name not in self._slots]:
            raise CaptureError(f"outputs {missing} of the graph are values that nothing computes.")
        self._outputs = tuple(self._slots[name] for name in graph.outputs)

    def __call__(self, inputs: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Run the graph.

        Args:
            inputs: value of each of the graph's inputs, by name, of its type for some number of streams B; entries
                that are no inputs are ignored, so that one environment can be given to several graphs.

        Raises:
            ObservationError: an input is missing, or has a dtype or shape that is not its type's, or sizes
                contradict each other about B.
            CaptureError: an operation fails on these values; names the node.
        """
        return self.run([inputs[name] for name in self._graph.inputs], bind_batch(self._graph.inputs, inputs))

    def run(self, inputs: Sequence[torch.Tensor], streams: int) -> tuple[torch.Tensor, ...]:
        """The same for inputs in order, which are known to fit, and for so many streams."""
        frame: Frame = [*inputs, *self._constants]
        index = 0
        try:
            for call, dead in self._steps:
                frame.append(call(frame, streams))
                for slot in dead:
                    frame[slot] = None
                index += 1
        except (RuntimeError, TypeError, ValueError, IndexError, NotImplementedError) as error:
            node = self._graph.nodes[index]
            raise CaptureError(f"{_where(node)} failed for {streams} streams: {error}") from error
        return tuple(frame[slot] for slot in self._outputs)

    def _compile(self, node: Node) -> Getter:
        function, positional, names = resolve_op(node), len(node.args), [name for name, _ in node.kwargs]
        fixed, getter = self._argument(node, (*node.args, *(value for _, value in node.kwargs)))

        def call(frame: Frame, streams: int) -> Any:
            values = fixed if getter is None else getter(frame, streams)
            if not names:
                return function(*values)
            return function(*values[:positional], **dict(zip(names, values[positional:], strict=True)))

        return call

    def _argument(self, node: Node, argument: Argument) -> tuple[Any, Getter | None]:
        """Either a value, or a getter of a value that depends on the frame or on B."""
        if isinstance(argument, Ref):
            if argument.name not in self._slots:
                raise CaptureError(f"{_where(node)} reads %{argument.name}, which nothing before it computes.")
            slot = self._slots[argument.name]
            return None, lambda frame, streams: frame[slot]
        if isinstance(argument, Batch):
            if not self._bound:
                raise CaptureError(f"{_where(node)} has the size {argument}, but no input of its graph has a batch.")
            multiple = argument.multiple
            return None, lambda frame, streams: multiple * streams
        if isinstance(argument, Enum):
            return resolve_enum(node, argument, self._device), None
        if isinstance(argument, tuple):
            both = [self._argument(node, item) for item in argument]
            fixed, changing = [value for value, _ in both], [(i, g) for i, (_, g) in enumerate(both) if g is not None]
            if not changing:
                return fixed, None

            def build(frame: Frame, streams: int) -> list[Any]:
                values = fixed.copy()
                for i, getter in changing:
                    values[i] = getter(frame, streams)
                return values

            return None, build
        return argument, None


def resolve_enum(node: Node, argument: Enum, device: torch.device) -> Any:
    """The torch object that an enumeration among the arguments of a node names; a device is ``device``."""
    if argument.kind == "device":
        return device
    value = getattr(torch, argument.name, None)
    if argument.kind not in _ENUM_TYPES or not isinstance(value, _ENUM_TYPES[argument.kind]):
        raise CaptureError(f"{_where(node)} has the argument {argument}; torch has no such {argument.kind}.")
    return value


def bind_batch(types: Mapping[str, TensorType], values: Mapping[str, torch.Tensor]) -> int:
    """The number of streams B that makes ``values`` fit ``types``; 1 if no type depends on it."""
    streams: int | None = None
    origin = ""
    for name, type_ in types.items():
        value = values.get(name)
        if value is None:
            raise ObservationError(f"input {name!r} is missing; expected {type_}, found inputs {sorted(values)}.")
        shape = tuple(value.shape)
        if len(shape) != len(type_.shape) or value.dtype != getattr(torch, type_.dtype, None):
            raise ObservationError(f"input {name!r} has type {_describe(value)}; expected {type_}.")
        for axis, (found, expected) in enumerate(zip(shape, type_.shape, strict=True)):
            if isinstance(expected, int):
                if found != expected:
                    wrong = f"input {name!r} has type {_describe(value)}; expected {type_}: axis {axis} differs."
                    raise ObservationError(wrong)
                continue
            count, rest = divmod(found, expected.multiple)
            if rest or count < 1 or streams not in (None, count):
                known = f" with B = {streams} from {origin!r}" if streams is not None else ""
                raise ObservationError(
                    f"input {name!r} has size {found} in axis {axis}; expected {expected}{known}. All inputs of a call"
                    " must hold the same number of streams, at least one."
                )
            streams, origin = count, name
    return 1 if streams is None else streams


def _dead_after(graph: Graph) -> dict[str, list[str]]:
    """By node: the inputs and results that nothing reads after it. Constants stay."""
    last = {name: node.name for node in graph.nodes for name in (node.name, *node.refs())}
    dead: dict[str, list[str]] = {node.name: [] for node in graph.nodes}
    for name, reader in last.items():
        if name not in graph.outputs and name not in graph.constants:
            dead[reader].append(name)
    return dead


def _dropout_is_off(node: Node) -> bool:
    """Of an operation that counts as random for the sake of its dropout argument."""
    row = find_operation(node.op)
    if row is None or row.dropout is None:
        return False
    position, name = row.dropout
    return node.argument(position, dict(node.kwargs).get(name, 0)) in (0, 0.0, False)


def _where(node: Node) -> str:
    return f"node {node}" + (f" ({node.source})" if node.source else "")


def _describe(value: torch.Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"


def drawn(type_: TensorType, rows: int, rng: np.random.Generator) -> torch.Tensor:
    """Random numbers of a type, for so many rows: normal ones, or 0 and 1 of integers."""
    real = type_.dtype.startswith("float")
    numbers = rng.standard_normal(type_.at(rows)) if real else rng.integers(0, 2, type_.at(rows))
    return torch.from_numpy(numbers.astype(type_.dtype))
