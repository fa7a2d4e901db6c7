"""``lower.layout``: moving operations composed and delayed."""

import pytest
import torch
from hypothesis import given, settings, strategies as st

from tests.lower.modules import ALL, captured, random_values
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Argument, Batch, Graph, Node, Ref, Size, TensorType
from ttscompile.lower.layout import product, ratio, sink_layout
from ttscompile.lower.program import structural_key

B = Batch()


def moves(graph: Graph) -> int:
    """Operations that copy values to other places; a reshape copies nothing."""
    return sum(node.op in ("aten.permute.default", "aten.transpose.int", "aten.clone.default") for node in graph.nodes)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_same_function_no_more_moves_and_nothing_left_to_do(name: str) -> None:
    _, graph, weights = captured(name)
    sunk = sink_layout(graph)
    assert (sunk.inputs, sunk.outputs) == (graph.inputs, graph.outputs)
    assert sunk.types()[sunk.outputs[0]] == graph.types()[graph.outputs[0]]
    assert moves(sunk) <= moves(graph)
    assert structural_key(sink_layout(sunk)) == structural_key(sunk)
    for streams in (1, 2, 5):
        inputs = random_values(graph.inputs, streams)
        with Counted() as counted:
            wanted = evaluate(graph, weights, inputs)
        for found, expected in zip(evaluate(sunk, weights, inputs), wanted, strict=True):
            assert_equal_but_for_rounding(found, expected, counted.terms)


def test_self_attention_keeps_four_moves_of_eight() -> None:
    _, graph, _ = captured("SelfAttention")
    assert moves(graph) == 8
    assert moves(sink_layout(graph)) == 4  # heads of query, key, value, and back
    linears = [n for n in sink_layout(graph).nodes if n.op == "aten.linear.default"]
    assert [n.type.shape[0] for n in linears] == [Batch(6), Batch(6)]


class Recorder:
    """Builds a graph by running it, so that every type is what torch says."""

    def __init__(self) -> None:
        self.inputs = {"x": TensorType((B, 4, 6), "float32"), "y": TensorType((6, Batch(2)), "float32")}
        self.constants = {"w": TensorType((6, 6), "float32"), "b": TensorType((6,), "float32")}
        self.weights = random_values(self.constants, 1)
        self.nodes: list[Node] = []

    def graph(self, *outputs: str) -> Graph:
        return Graph(self.inputs, self.constants, tuple(self.nodes), outputs)

    def add(self, op: str, *args: Argument) -> None:
        """Append a node; its type is found by running the graph at B = 5 and B = 7."""
        name = f"n{len(self.nodes)}"
        node = Node(name, op, args, (), (TensorType((), "float32"),))
        shapes = [
            evaluate(Graph(self.inputs, self.constants, (*self.nodes, node), (name,)), self.weights, inputs)[0].shape
            for inputs in (random_values(self.inputs, 5), random_values(self.inputs, 7))
        ]
        sizes: list[Size] = [a if a == b else Batch(a // 5) for a, b in zip(*shapes, strict=True)]
        self.nodes.append(Node(name, op, args, (), (TensorType(tuple(sizes), "float32"),)))

    def type_of(self, name: str) -> TensorType:
        return self.graph().types()[name]


def alike(recorder: Recorder, name: str) -> list[str]:
    """Values of the same type as this one."""
    return [other for other, type_ in recorder.graph().types().items() if type_ == recorder.type_of(name)]


CHOICES = ["permute", "transpose", "reshape", "merge", "split", "unsqueeze", "select", *["compute"] * 3]


@st.composite
# C901, PLR0912: a branch for each operation
def moving_graphs(draw: st.DrawFn) -> tuple[Graph, dict[str, torch.Tensor]]:  # noqa: C901, PLR0912
    recorder = Recorder()
    for _ in range(draw(st.integers(1, 9))):
        made = [n.name for n in recorder.nodes]
        name = draw(st.sampled_from(["x", "y", *made, *made[-1:] * 6]))
        shape = recorder.type_of(name).shape
        rank, choice = len(shape), draw(st.sampled_from(CHOICES))
        if choice == "permute":
            recorder.add("aten.permute.default", Ref(name), tuple(draw(st.permutations(range(rank)))))
        elif choice == "transpose" and rank:
            axes = st.integers(-rank, rank - 1)
            recorder.add("aten.transpose.int", Ref(name), draw(axes), draw(axes))
        elif choice == "reshape" and product(shape) is not None:
            target = tuple(draw(st.permutations(shape)))
            recorder.add("aten.reshape.default", Ref(name), target)
        elif choice == "merge" and rank > 1:
            axis = draw(st.integers(0, rank - 2))
            if (size := product(shape[axis : axis + 2])) is not None:
                recorder.add("aten.reshape.default", Ref(name), (*shape[:axis], size, *shape[axis + 2 :]))
        elif choice == "split" and rank:
            axis, factor = draw(st.integers(0, rank - 1)), draw(st.sampled_from([2, 3, 1, 6]))
            if (rest := ratio(shape[axis], factor)) is not None:
                pair = draw(st.permutations([factor, rest]))
                recorder.add("aten.reshape.default", Ref(name), (*shape[:axis], *pair, *shape[axis + 1 :]))
        elif choice == "unsqueeze" and rank < 7:
            recorder.add("aten.unsqueeze.default", Ref(name), draw(st.integers(0, rank)))
        elif choice == "select" and rank:
            axis = draw(st.integers(0, rank - 1))
            if isinstance(size := shape[axis], int):
                recorder.add("aten.select.int", Ref(name), axis, draw(st.integers(-size, size - 1)))
        elif choice == "compute":
            if rank and shape[-1] == 6 and draw(st.booleans()):
                recorder.add("aten.linear.default", Ref(name), Ref("w"), Ref("b"))
            elif rank and shape[-1] == 6 and draw(st.booleans()):
                recorder.add("aten.layer_norm.default", Ref(name), (6,), Ref("b"))
            elif rank and draw(st.booleans()):
                recorder.add("aten.cumsum.default", Ref(name), draw(st.integers(0, rank - 1)))  # sees the order
            elif draw(st.booleans()):
                recorder.add("aten.mul.Tensor", Ref(name), Ref(draw(st.sampled_from(alike(recorder, name)))))
            else:
                recorder.add("aten.tanh.default", Ref(name))
    values = ["x", "w", *[n.name for n in recorder.nodes]]
    outputs = draw(st.lists(st.sampled_from(values), min_size=1, max_size=3, unique=True))
    return recorder.graph(*outputs), recorder.weights


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(moving_graphs())
def test_any_sequence_of_moves_and_computations(case: tuple[Graph, dict[str, torch.Tensor]]) -> None:
    graph, weights = case
    sunk = sink_layout(graph)
    assert sunk.outputs == graph.outputs
    for streams in (1, 2, 3):
        inputs = random_values(graph.inputs, streams)
        torch.testing.assert_close(evaluate(sunk, weights, inputs), evaluate(graph, weights, inputs), equal_nan=True)


def test_one_value_under_two_names_and_an_input_as_output() -> None:
    type_ = TensorType((B, 2), "float32")
    nodes = (
        Node("a", "aten.exp.default", (Ref("x"),), (), (type_,)),
        Node("b", "aten.clone.default", (Ref("a"),), (), (type_,)),
        Node("c", "aten.clone.default", (Ref("x"),), (), (type_,)),
    )
    graph = Graph({"x": type_}, {}, nodes, ("a", "b", "c", "x"))
    x = torch.randn(3, 2)
    torch.testing.assert_close(evaluate(sink_layout(graph), {}, {"x": x}), (x.exp(), x.exp(), x, x))


def test_sizes() -> None:
    assert product([2, B, 3]) == Batch(6) and product([2, 3]) == 6 and product([B, B]) is None
    assert ratio(Batch(6), 3) == Batch(2) and ratio(Batch(6), Batch(3)) == 2
    assert ratio(6, Batch(3)) is None and ratio(6, 4) is None and ratio(Batch(6), 4) is None and ratio(6, 0) is None
