"""Where torch would promote types: where it computes with another type than it is given.

To find that out its exporter evaluates every operation once more. The types of our graphs are known, so the usual
places are written out, and the exporter looks for others only where there may be some.
"""

from ..ir.graph import Argument, Graph, Node
from ..ir.operations import Types, find_operation

_SUMS = ("sum", "prod", "cumsum", "cumprod")
"""Of truth values and small whole numbers they are int64."""

_MIXED = (
    *("embedding", "index", "index_select", "index_copy", "gather", "take_along_dim"),
    *("argmax", "argmin", "topk", "sort"),
    *("scaled_dot_product_attention", "pad", "_to_copy"),
)
"""They are given, or give, several types: indices, masks, what is converted, what a mask is padded with."""


def summed_as(node: Node, types: Types) -> str | None:
    """The type that a sum's argument has to be converted to; None where it has it, and of what is no sum."""
    converted = _name(node) in _SUMS and _given(node, types) != [node.type.dtype]
    return node.type.dtype if converted else None


def beside_floats(node: Node, argument: Argument, types: Types) -> Argument:
    """An argument as it is; a whole number as a floating-point one, beside which it is computed with."""
    known = {*_given(node, types), node.type.dtype} - {"bool"}
    return float(argument) if type(argument) is int and _elementwise(node) and known == {"float32"} else argument


def may_promote(graph: Graph) -> bool:
    """Whether there may be other places."""
    types = graph.types()
    return any(_may_promote(node, types) for node in graph.nodes)


def _may_promote(node: Node, types: Types) -> bool:
    name, given, made = _name(node), _given(node, types), node.types[0].dtype
    if name in (*_SUMS, *_MIXED):
        return False
    if name in ("where", "masked_fill") and "bool" in given:
        given.remove("bool")
    if made == "bool" and _elementwise(node) and given:  # a comparison
        made = given[0]
    fractions = not made.startswith("float") and any(isinstance(each, float) for each in node.leaves())
    return fractions or not {*given} <= {made}


def _given(node: Node, types: Types) -> list[str]:
    return [types[name].dtype for name in node.refs()]


def _elementwise(node: Node) -> bool:
    row = find_operation(node.op)
    return row is not None and row.elementwise


def _name(node: Node) -> str:
    return node.op.removeprefix("aten.").partition(".")[0]
