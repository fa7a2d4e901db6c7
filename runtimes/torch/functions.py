"""A graph as one Python function of torch's operations, written out for one number of streams.

``ir.evaluate`` says what a graph means, and looks every value up. Here it is written as Python source, once, when
shapes and layouts are known::

    def function(i0, i1, i2):
        v3 = f3(i0, [256], c4, c5, 1e-05, False)
        v6 = f6(v3, c7, c8)
        s9 = as_strided(v6, (1, 4, 12, 64), (3072, 64, 256, 1), 0)
        ...

What reads constants alone is computed now. A chain of operations that only change how memory is seen is one
``as_strided``: of the 25 operations of a self-attention 8 are left. And operations are called by torch's own Python
functions where there are such, which takes a microsecond less than calling the ATen overload.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ttscompile.errors import CaptureError
from ttscompile.ir.evaluate import resolve_enum, resolve_op
from ttscompile.ir.graph import Argument, Batch, Enum, Graph, Node, Ref

PACKED_LINEAR: Callable[..., Any] | None = None
"""``linear`` of x, a packed weight and a bias, then "none" or "gelu", no scalars, and how gelu is approximated."""
if torch._C._has_mkldnn and hasattr(torch.ops.mkldnn, "_linear_pointwise"):
    PACKED_LINEAR = torch.ops.mkldnn._linear_pointwise.default._op  # without a frame of Python's around it

HALF_LINEAR: Callable[..., Any] | None = None
"""``linear`` of x and what ``half_weight`` made."""
if {"x86", "fbgemm"}.intersection(torch.backends.quantized.supported_engines):
    HALF_LINEAR = torch.ops.quantized.linear_dynamic_fp16.default._op

LINEAR, GELU, MUL = "aten.linear.default", "aten.gelu.default", "aten.mul.Tensor"


def packs(value: Any, weight: Any) -> bool:
    """Whether a linear layer on this value, with this constant weight, can be packed as a library's kernels read it.

    A block streams its weights from memory once a step. Read as they are stored, rows of one output each, by MKL, they
    come at half the speed: with 29 MB of weights in turn and 16 rows, the six products of a decoder layer of width 256
    take 820 us so, 500 us packed by oneDNN, and 400 us packed by FBGEMM in half precision. FBGEMM reads half as many
    bytes and computes in float32, so it is taken for weights that half precision holds as they are: those of a policy
    that was saved so. The operations are those that TorchInductor packs weights with when it freezes a model, and those
    of torch's quantized layers.
    """
    there = PACKED_LINEAR is not None and hasattr(torch.ops.mkldnn, "_reorder_linear_weight")
    fits = all(isinstance(t, Tensor) and t.device.type == "cpu" and t.dtype == torch.float32 for t in (value, weight))
    return there and fits and weight.ndim == 2 and value.ndim > 1 and value.numel() > 0 < weight.numel()


def half_weight(weight: Tensor, bias: Tensor | None) -> Any:
    """A weight that half precision holds as it is, with its bias; None for any other, and where FBGEMM is not."""
    usable = HALF_LINEAR is not None and torch.backends.quantized.engine in ("x86", "fbgemm")
    if not usable or not torch.equal(weight.half().float(), weight):
        return None
    return torch.ops.quantized.linear_prepack_fp16(weight, bias)


Function = Callable[..., tuple[Tensor, ...]]
"""Takes the graph's inputs in order, and gives its outputs in order."""

_OWN: Mapping[str, Callable[..., Any]] = {
    "aten.linear.default": functional.linear,
    "aten.gelu.default": functional.gelu,
    "aten.scaled_dot_product_attention.default": functional.scaled_dot_product_attention,
    "aten.layer_norm.default": torch.layer_norm,
    "aten.add.Tensor": torch.add,
    "aten.sub.Tensor": torch.sub,
    "aten.mul.Tensor": torch.mul,
    "aten.tanh.default": torch.tanh,
    "aten.sigmoid.default": torch.sigmoid,
    "aten.matmul.default": torch.matmul,
    "aten.bmm.default": torch.bmm,
    "aten.cat.default": torch.cat,
    "aten.reshape.default": torch.reshape,
    "aten.transpose.int": torch.transpose,
    "aten.permute.default": torch.permute,
    "aten.unsqueeze.default": torch.unsqueeze,
}
"""Torch's Python functions that take the arguments of an overload as they are."""

_ROOT_MEAN_SQUARE = ("aten.rsqrt.default", "aten.add.Tensor", "aten.mean.dim", "aten.pow.Tensor_Scalar")
"""What divides a value by the root of the mean of its squares, the last operation first."""

_PRODUCTS = frozenset(f"aten.{name}.default" for name in ("linear", "addmm", "mm", "matmul", "bmm", "convolution"))
"""Operations that autocast computes in the narrower type, so that their constants can be kept in it."""


def write_function(
    graph: Graph, weights: Mapping[str, Tensor], examples: Sequence[Tensor], streams: int, narrow: torch.dtype | None
) -> Function:
    """A graph as a function.

    Args:
        examples: its inputs in order. Those of every call must have the same shapes, strides and device.
        narrow: type to keep the constants of products in; the caller then runs the function under autocast.

    Raises:
        CaptureError: an operation that ``resolve_op`` refuses, or a constant that is missing.
    """
    device = next((value.device for value in (*examples, *weights.values())), torch.device("cpu"))
    users = graph.users()
    readers = {name: len(nodes) + (name in graph.outputs) for name, nodes in users.items()}
    writer = _Writer(streams, device, readers, narrow)
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


@dataclass(frozen=True)
class _Line:
    """``name = text``, which reads these names."""

    name: str
    text: str
    reads: tuple[str, ...]


class _Writer:
    """The function while it is written; every value is also computed for the examples.

    A value is known to the source by a name of its own. One that only sees the memory of a computed one has no line
    until something else reads it.
    """

    def __init__(
        self, streams: int, device: torch.device, readers: Mapping[str, int], narrow: torch.dtype | None
    ) -> None:
        self._streams, self._device, self._narrow = streams, device, narrow
        self._nodes: dict[str, Node] = {}
        self._narrowed: dict[str, str] = {}  # by name in the source, that of the same in the type of products
        self._readers = readers  # how many nodes read a value, outputs counted as one more
        self._packed_nodes: dict[str, Node] = {}  # by name, what is computed in the place of linear layers
        self._numbers = count()
        self._values: dict[str, Any] = {}  # by name in the graph, for the examples
        self._names: dict[str, str] = {}  # in the source, by name in the graph
        self._fixed: set[str] = set()  # names in the graph of what depends on no input
        self._parameters: list[str] = []
        self._lines: list[_Line] = []
        self._scope: dict[str, Any] = {"as_strided": torch.as_strided, "to": Tensor.to, "narrow": narrow}
        self._owners: dict[int, tuple[str, Tensor]] = {}  # by storage: the computed value that made it
        self._seen: dict[tuple[Any, ...], str] = {}  # names of views that have a line

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
        """Compute a node, and write it down unless it is fixed or a view."""
        self._nodes[node.name], resolved = node, resolve_op(node)  # which refuses what must not run
        node, function = self._packed(node) or self._norm(node) or (node, _OWN.get(node.op, resolved))
        args = [self._value(node, argument) for argument in node.args]
        kwargs = {name: self._value(node, argument) for name, argument in node.kwargs}
        value = function(*args, **kwargs)
        if all(name in self._fixed for name in node.refs()):
            self.fix(node.name, value)
            return
        self._values[node.name] = value
        owner = self._owners.get(_storage(value)) if isinstance(value, Tensor) and value.numel() else None
        if owner is not None and _is_plain_view(value, owner[1]):
            return
        name = self._names[node.name] = self._new("v")
        called, reads = f"f{name[1:]}", list[str]()
        self._scope[called] = function
        texts = [self._text(node, argument, reads) for argument in node.args]
        texts += [f"{key}={self._text(node, argument, reads)}" for key, argument in node.kwargs]
        self._lines.append(_Line(name, f"{called}({', '.join(texts)})", tuple(reads)))
        if isinstance(value, Tensor) and value.numel() and not self._is_foreign(node, value):
            self._owners.setdefault(_storage(value), (name, value))

    def _norm(self, node: Node) -> tuple[Node, Callable[..., Any]] | None:
        """RMSNorm, where a node is the last of the six that it was captured as; None for any other node."""

        def made_by(argument: Argument, op: str) -> Node | None:
            found = self._nodes.get(argument.name) if isinstance(argument, Ref) else None
            return found if found is not None and found.op == op else None

        chain = [node if node.op == MUL else None]
        for place, op in enumerate((MUL, *_ROOT_MEAN_SQUARE)):
            before = chain[-1]
            chain.append(None if before is None else made_by(before.args[place == 1], op))
        _, scaled, _, added, mean, square = chain
        if scaled is None or added is None or mean is None or square is None:
            return None
        (value, _), (_, weight), (_, eps) = scaled.args, node.args, added.args
        if square.args != (value, 2) or mean.args[1:] != ((-1,), True) or not isinstance(weight, Ref):
            return None
        shape = self._values[scaled.name].shape[-1:]
        if weight.name not in self._fixed or self._values[weight.name].shape != shape or not isinstance(eps, float):
            return None
        return replace(node, args=(value, tuple(shape), weight, eps)), torch.rms_norm

    def _packed(self, node: Node) -> tuple[Node, Callable[..., Any]] | None:
        """What does the same as a node on a packed weight: its arguments, and the function; None if nothing does."""
        before = self._packed_nodes.get(next(node.refs(), ""))
        if node.op == GELU and before is not None and before.args[3] == "none" and self._readers[before.name] == 1:
            kind = str(dict(node.kwargs).get("approximate", "none"))  # or "tanh"
            return self._with_packed(replace(before, name=node.name, args=(*before.args[:3], "gelu", (), kind)))
        if node.op != LINEAR or node.kwargs or not isinstance(node.args[0], Ref) or not isinstance(node.args[1], Ref):
            return None
        value, weight = (self._values[each.name] for each in node.args[:2] if isinstance(each, Ref))
        fixed = [name in self._fixed for name in node.refs()]
        if fixed[0] or not all(fixed[1:]) or not packs(value, weight):
            return None
        name, bias = f"{node.name}.packed", (*node.args, None)[2]
        half = half_weight(weight, self._values[bias.name] if isinstance(bias, Ref) else None)
        if half is not None and HALF_LINEAR is not None:
            self.fix(name, half)
            return replace(node, args=(node.args[0], Ref(name))), HALF_LINEAR
        rows = value.numel() // value.shape[-1]  # for which the library lays it out
        self.fix(name, torch.ops.mkldnn._reorder_linear_weight(weight, rows))
        return self._with_packed(replace(node, args=(node.args[0], Ref(name), bias, "none", (), "")))

    def _with_packed(self, node: Node) -> tuple[Node, Callable[..., Any]]:
        """A node with the arguments of ``PACKED_LINEAR``, which a later one may take the place of."""
        assert PACKED_LINEAR is not None  # or nothing packs
        self._packed_nodes[node.name] = node
        return node, PACKED_LINEAR

    def function(self, outputs: Sequence[str]) -> Function:
        """The function with these results."""
        results = [self._named(name) for name in outputs]
        needed, kept = set(results), list[str]()
        for line in reversed(self._lines):
            if line.name in needed:
                needed.update(line.reads)
                kept.append(f"    {line.name} = {line.text}\n")
        body = "".join(reversed(kept))
        source = (
            f"def function({', '.join(self._parameters)}):\n{body}    return ({''.join(f'{r}, ' for r in results)})"
        )
        # Names made here, and those of arguments that the operation has taken: nothing else of an artifact.
        exec(compile(source, "<function of a graph>", "exec"), self._scope)  # noqa: S102
        made: Function = self._scope["function"]
        return made

    def _new(self, kind: str) -> str:
        return f"{kind}{next(self._numbers)}"

    def _is_foreign(self, node: Node, value: Tensor) -> bool:
        """Whether a value sees the memory of one of the node's arguments, which the function did not make."""
        own = _storage(value)
        read = (self._values[name] for name in node.refs())
        return any(isinstance(each, Tensor) and _storage(each) == own for each in read)

    def _named(self, name: str) -> str:
        """What the source calls a value; a view gets its line now."""
        if name in self._names:
            return self._names[name]
        value = self._values[name]
        root, owner = self._owners[_storage(value)]
        place = (tuple(value.shape), value.stride(), value.storage_offset())
        if place == (tuple(owner.shape), owner.stride(), owner.storage_offset()):
            return root
        if (root, *place) not in self._seen:
            text = f"as_strided({root}, {place[0]}, {place[1]}, {place[2]})"
            self._lines.append(_Line(self._seen.setdefault((root, *place), self._new("s")), text, (root,)))
        return self._seen[root, *place]

    def _text(self, node: Node, argument: Argument, reads: list[str]) -> str:
        """An argument in the source; names that it reads go to ``reads``."""
        if isinstance(argument, Ref):
            name, value = self._named(argument.name), self._values[argument.name]
            wide = isinstance(value, Tensor) and value.dtype == torch.float32 and argument.name not in self._fixed
            if self._narrow is not None and node.op in _PRODUCTS and wide:
                if name not in self._narrowed:  # autocast would do it once for each product that reads it
                    self._narrowed[name] = self._new("n")
                    self._lines.append(_Line(self._narrowed[name], f"to({name}, narrow)", (name,)))
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


def _storage(value: Tensor) -> int:
    """Which memory a tensor sees; a packed weight has none that can be seen."""
    return -1 if value.is_mkldnn else int(value.untyped_storage()._cdata)


def _is_plain_view(value: Tensor, owner: Tensor) -> bool:
    """Whether a value is what ``as_strided`` makes of another one with the same memory."""
    return value.dtype == owner.dtype and not (value.is_conj() or value.is_neg() or owner.is_conj() or owner.is_neg())
