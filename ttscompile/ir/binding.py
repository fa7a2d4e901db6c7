"""Binding times: the earliest moment at which each value of a graph is known."""

from collections.abc import Mapping
from functools import reduce

from ..core.spec import PolicySpec
from .graph import Batch, Graph
from .program import Binding

_RANK = {Binding.CONSTANT: 0, Binding.TABLE: 1, Binding.CONDITION: 1, Binding.STEP: 2, Binding.LOOP: 3}


def join(left: Binding, right: Binding) -> Binding:
    """The binding of what depends on both: a table row and a condition make a step value."""
    if left is not right and _RANK[left] == _RANK[right]:
        return Binding.STEP
    return left if _RANK[left] >= _RANK[right] else right


def input_bindings(spec: PolicySpec) -> dict[str, Binding]:
    """Binding of what the prologue reads: timestep and observations."""
    return {spec.timestep_argument: Binding.TABLE, **dict.fromkeys(spec.inputs, Binding.CONDITION)}


def bindings(graph: Graph, inputs: Mapping[str, Binding]) -> dict[str, Binding]:
    """Binding of every value.

    A value without inputs whose shape has the batch in it (``zeros(B, 1, E)``, a class token for every image) is no
    constant; by itself it counts as a table, whose rows are made for a batch of one. It does not make what reads it a
    table: beside an observation it is made once a call, like that.
    """
    found = {**dict.fromkeys(graph.constants, Binding.CONSTANT), **inputs}
    shaped: set[str] = set()  # of nothing but constants and the batch size
    for node in graph.nodes:
        read = list(node.refs())
        if (node.mentions_batch() or not shaped.isdisjoint(read)) and all(
            found[name] is Binding.CONSTANT or name in shaped for name in read
        ):
            shaped.add(node.name)
            found[node.name] = Binding.TABLE
            continue
        # The batch size comes with the inputs.
        found[node.name] = reduce(join, (found[name] for name in read if name not in shaped), Binding.CONSTANT)
    return found


def numbering(graph: Graph) -> set[str]:
    """Values that number the streams: ``arange(B)`` in ``tokens[arange(B), last]``, and indices that are made of it.

    They mean something only for the streams that are computed together: all, those of one plan, or all steps of all
    streams. So they do not cross from piece to piece; each piece makes its own.
    """
    found: set[str] = set()
    for node in graph.nodes:
        read = set(node.refs())
        alone = read <= found | graph.constants.keys()
        if found & read:
            numbers = alone or not node.type.dtype.startswith("float")  # a float is what they were used for
        else:  # a batch size that is no size of a shape is a number
            numbers = alone and any(isinstance(a, Batch) for a in (*node.args, *(value for _, value in node.kwargs)))
        if numbers:
            found.add(node.name)
    return found


def one_step_at_a_time(graph: Graph, spec: PolicySpec) -> set[str]:
    """Step values of ``timestep[0]`` and an observation: of all steps in one batch, no row could have its own."""
    types = graph.types()
    known = bindings(graph, {**input_bindings(spec), spec.sample_argument: Binding.LOOP})
    found = {
        name
        for name, binding in known.items()
        if binding is Binding.TABLE and not any(isinstance(size, Batch) for size in types[name].shape)
    }
    tables = set(found)
    for node in graph.nodes:
        if known[node.name] is Binding.STEP and not found.isdisjoint(node.refs()):
            found.add(node.name)
    return found - tables
