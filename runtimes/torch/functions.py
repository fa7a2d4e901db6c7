"""A graph as one Python function of torch's operations, written out for one number of streams.

``ir.evaluate`` says what a graph means, and looks every value up. Here it is written as Python source, once, when
shapes are known::

    def function(i0, i1, i2):
        v3 = f3(i0, a4, c5, a6)
        n7 = to(v3, narrow)
        v8 = f8(n7, c9)
        ...

What reads constants alone is computed now. An RMSNorm is one operation of torch's, and not the six that it was captured
as. In a narrower type, what several products read is converted once: autocast would do it for each of them. On a GPU
every operation that is saved is a kernel of three microseconds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import torch
from torch import Tensor

from ttscompile.errors import CaptureError
from ttscompile.ir.evaluate import resolve_enum, resolve_op
from ttscompile.ir.graph import Argument, Batch, Enum, Graph, Node, Ref

Function = Callable[..., tuple[Tensor, ...]]
"""Takes the graph's inputs in order, and gives its outputs in order."""

_RMS_NORM = ("mul.Tensor", "mul.Tensor", "rsqrt.default", "add.Tensor", "mean.dim", "pow.Tensor_Scalar")
"""What an RMSNorm is captured as, the last operation first."""

_PRODUCTS = frozenset(f"aten.{name}.default" for name in ("linear", "addmm", "mm", "matmul", "bmm", "convolution"))
"""Operations that autocast computes in the narrower type, so that their constants can be kept in it."""


def write_function(
    graph: Graph, weights: Mapping[str, Tensor], examples: Sequence[Tensor], streams: int, narrow: torch.dtype | None
) -> Function:
    """A graph as a function of inputs with the shapes and device of these examples, in order.

    ``narrow`` is the type to keep the constants of products in; the caller then runs the function under autocast.

    Raises:
        CaptureError: an operation that ``resolve_op`` refuses, or a constant that is missing.
    """
    device = next((value.device for value in (*examples, *weights.values())), torch.device("cpu"))
    users = graph.users()
    writer = _Writer(streams, device, narrow)
    for name, value in zip(graph.inputs, examples, strict=True):
        writer.take_input(name, value)
    for name in graph.constants:
        if name not in weights:
            raise CaptureError(f"constant %{name} of the graph has no value among the weights.")
        product = all(node.op in _PRODUCTS for node in users[name])
        to_narrow = narrow is not None and product and weights[name].dtype == torch.float32
        writer.fix(name, weights[name].to(narrow) if to_narrow else weights[name])
    for node in graph.nodes:
        writer.write(node)
    return writer.function(graph.outputs)


class _Writer:
    """The function while it is written; every value is also computed for the examples, and has a name in the source."""

    def __init__(self, streams: int, device: torch.device, narrow: torch.dtype | None) -> None:
        self._streams, self._device, self._narrow = streams, device, narrow
        self._nodes: dict[str, Node] = {}
        self._numbers = count()
        self._values: dict[str, Any] = {}  # by name in the graph, for the examples
        self._names: dict[str, str] = {}  # in the source, by name in the graph
        self._narrowed: dict[str, str] = {}  # by name in the source, that of the same in the type of products
        self._fixed: set[str] = set()  # names in the graph of what depends on no input
        self._parameters: list[str] = []
        self._lines: list[tuple[str, str, list[str]]] = []  # ``name = text``, and the names that it reads
        self._scope: dict[str, Any] = {"to": Tensor.to, "narrow": narrow}

    def take_input(self, name: str, value: Any) -> None:
        """The next parameter."""
        self._names[name], self._values[name] = self._new("i"), value
        self._parameters.append(self._names[name])

    def fix(self, name: str, value: Any) -> None:
        """A value that is the same in every call."""
        self._fixed.add(name)
        self._names[name], self._values[name] = self._new("c"), value
        self._scope[self._names[name]] = value

    def write(self, node: Node) -> None:
        """Compute a node, and write it down unless it is fixed."""
        self._nodes[node.name], function = node, resolve_op(node)  # which refuses what must not run
        node, function = self._norm(node) or (node, function)
        args = [self._value(node, argument) for argument in node.args]
        value = function(*args, **{name: self._value(node, argument) for name, argument in node.kwargs})
        if all(name in self._fixed for name in node.refs()):
            self.fix(node.name, value)
            return
        name = self._new("v")
        called, reads = f"f{name[1:]}", list[str]()
        self._scope[called] = function
        texts = [self._text(node, argument, reads) for argument in node.args]
        texts += [f"{key}={self._text(node, argument, reads)}" for key, argument in node.kwargs]
        self._lines.append((name, f"{called}({', '.join(texts)})", reads))
        self._names[node.name], self._values[node.name] = name, value

    def _norm(self, node: Node) -> tuple[Node, Callable[..., Any]] | None:
        """RMSNorm, where a node is the last of the six that it was captured as; None for any other node."""
        chain, found = list[Node](), self._nodes.get(node.name)
        for place, op in enumerate(_RMS_NORM):
            if found is None or found.op != f"aten.{op}" or found.kwargs:
                return None
            chain.append(found)
            argument = found.args[place == 1]
            found = self._nodes.get(argument.name) if isinstance(argument, Ref) else None
        _, scaled, _, added, mean, square = chain
        (value, _), (_, weight), (_, eps) = scaled.args, node.args, added.args
        if square.args != (value, 2) or mean.args[1:] != ((-1,), True) or not isinstance(weight, Ref):
            return None
        shape, factor = self._values[scaled.name].shape[-1:], self._values[weight.name]
        # For a weight of another type torch has no kernel.
        alike = factor.shape == shape and factor.dtype == self._value(node, value).dtype
        if weight.name not in self._fixed or not alike or not isinstance(eps, float):
            return None
        return replace(node, args=(value, tuple(shape), weight, eps)), torch.rms_norm

    def function(self, outputs: Sequence[str]) -> Function:
        """The function with these results."""
        results = [self._names[name] for name in outputs]
        needed, kept = set(results), list[str]()
        for name, text, reads in reversed(self._lines):
            if name in needed:
                needed.update(reads)
                kept.append(f"    {name} = {text}\n")
        body = "".join(reversed(kept))
        result = "".join(f"{one}, " for one in results)
        source = f"def function({', '.join(self._parameters)}):\n{body}    return ({result})"
        # Names made here, and those of arguments that the operation has taken: nothing else of an artifact.
        exec(compile(source, "<function of a graph>", "exec"), self._scope)  # noqa: S102
        made: Function = self._scope["function"]
        return made

    def _new(self, kind: str) -> str:
        return f"{kind}{next(self._numbers)}"

    def _text(self, node: Node, argument: Argument, reads: list[str]) -> str:
        """An argument in the source; names that it reads go to ``reads``."""
        if isinstance(argument, Ref):
            name, value = self._names[argument.name], self._values[argument.name]
            wide = isinstance(value, Tensor) and value.dtype == torch.float32 and argument.name not in self._fixed
            if self._narrow is not None and node.op in _PRODUCTS and wide:
                if name not in self._narrowed:
                    self._narrowed[name] = self._new("n")
                    self._lines.append((self._narrowed[name], f"to({name}, narrow)", [name]))
                name = self._narrowed[name]
            reads.append(name)
            return name
        if isinstance(argument, tuple) and any(isinstance(each, Ref | tuple) for each in argument):
            return f"[{', '.join(self._text(node, each, reads) for each in argument)}]"
        name = self._new("a")
        self._scope[name] = self._value(node, argument)
        return name

    def _value(self, node: Node, argument: Argument) -> Any:
        if isinstance(argument, Ref):
            if argument.name not in self._values:
                raise CaptureError(f"node {node} reads %{argument.name}, which nothing before it computes.")
            return self._values[argument.name]
        if isinstance(argument, Batch):
            return argument.multiple * self._streams
        if isinstance(argument, Enum):
            return resolve_enum(node, argument, self._device)
        if isinstance(argument, tuple):
            return [self._value(node, each) for each in argument]
        return argument
