"""``ir.evaluate``: the meaning of graphs."""

import itertools
import weakref

import pytest
import torch

from tests.lower.modules import ALL, captured, random_values
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.errors import CaptureError, ObservationError
from ttscompile.ir.evaluate import Evaluator, bind_batch, evaluate, evaluator, resolve_op, without_stack_traces
from ttscompile.ir.graph import Argument, Batch, Enum, Graph, Node, Ref, TensorType

B = Batch()


def one_node(op: str, *args: Argument, inputs: dict[str, TensorType] | None = None) -> Graph:
    inputs = inputs or {"x": TensorType((B, 2), "float32")}
    return Graph(inputs, {}, (Node("y", op, args, (), (TensorType((B, 2), "float32"),), "user.py:7"),), ("y",))


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_equals_the_module(name: str) -> None:
    module, graph, weights = captured(name)
    run = Evaluator(graph, weights)
    for streams in (1, 2, 5):
        inputs = random_values(graph.inputs, streams)
        (result,) = run(inputs)
        with torch.no_grad(), Counted() as counted:
            expected = module(**inputs)
        assert_equal_but_for_rounding(result, expected, counted.terms)


def test_weights_that_may_only_be_read_are_neither_copied_nor_warned_of() -> None:
    module, graph, weights = captured("FeedForward")
    arrays = {name: value.detach().numpy() for name, value in weights.items()}
    for array in arrays.values():
        array.flags.writeable = False
    run, inputs = evaluator(graph, arrays), random_values(graph.inputs, 2)
    with torch.no_grad():
        torch.testing.assert_close(run(inputs)[0], module(**inputs))
        weights["down.weight"].zero_()
        torch.testing.assert_close(run(inputs)[0], inputs["sample"])


def test_gradients_reach_weights_and_inputs_and_updates_in_place_show() -> None:
    module, graph, weights = captured("FeedForward")
    weights = {name: value.requires_grad_() for name, value in weights.items()}
    run = Evaluator(graph, weights)
    inputs = {n: v.requires_grad_(v.is_floating_point()) for n, v in random_values(graph.inputs, 2).items()}
    run(inputs)[0].square().sum().backward()
    sample = inputs["sample"].detach().clone().requires_grad_()
    with Counted() as counted:
        module(sample, inputs["timestep"], inputs["obs"]).square().sum().backward()
    assert_equal_but_for_rounding(inputs["sample"].grad, sample.grad, counted.terms)
    for name, parameter in module.named_parameters():
        assert_equal_but_for_rounding(weights[name].grad, parameter.grad, counted.terms)
    with torch.no_grad():
        before = run(inputs)[0]
        weights["down.weight"].zero_()
        assert not torch.equal(run(inputs)[0], before)
        torch.testing.assert_close(run(inputs)[0], inputs["sample"].detach())


def test_values_are_freed_after_their_last_use() -> None:
    alive: list[weakref.ref[torch.Tensor]] = []
    type_ = TensorType((B,), "float32")
    names = ["x", *(f"v{i}" for i in range(6))]
    nodes = tuple(Node(b, "aten.neg.default", (Ref(a),), (), (type_,)) for a, b in itertools.pairwise(names))
    run = Evaluator(Graph({"x": type_}, {}, nodes, ("v5",)), {})
    most = 0

    class Watch(torch.overrides.TorchFunctionMode):
        def __torch_function__(self, function, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
            nonlocal most
            result = function(*args, **(kwargs or {}))
            if isinstance(result, torch.Tensor):
                alive.append(weakref.ref(result))
            most = max(most, sum(reference() is not None for reference in alive))
            return result

    x = torch.ones(3)
    with Watch():
        run({"x": x})
    assert len(alive) == 6
    assert most == 2  # the argument and the result


def test_symbolic_sizes_enumerations_lists_and_several_results() -> None:
    types = {"x": TensorType((2, Batch(3)), "float32")}
    half = TensorType((2, B), "float32")
    nodes = (
        Node("parts", "aten.split_with_sizes.default", (Ref("x"), (B, Batch(2)), 1), (), (half, half)),
        Node("a", "getitem", (Ref("parts"), 0), (), (half,)),
        Node("b", "getitem", (Ref("parts"), 1), (), (half,)),
        Node("c", "aten.cat.default", ((Ref("b"), Ref("a")), 1), (), (types["x"],)),
        Node("d", "aten._to_copy.default", (Ref("c"),), (("dtype", Enum("dtype", "float64")),), (types["x"],)),
        Node("z", "aten.zeros.default", ((B,),), (("device", Enum("device", "cuda:0")),), (half,)),
    )
    x = torch.arange(12.0).view(2, 6)
    d, z = evaluate(Graph(types, {}, nodes, ("d", "z")), {}, {"x": x, "unrelated": x})
    assert d.dtype == torch.float64 and z.shape == (2,)
    torch.testing.assert_close(d, torch.cat([x[:, 2:], x[:, :2]], 1).double())


@pytest.mark.parametrize(
    ("op", "message"),
    [
        ("aten.add_.Tensor", "not a pure function"),
        ("aten.add.out", "not a pure function"),
        ("aten.from_file.default", "not a pure function"),
        ("aten.rand_like.default", "random"),
        ("aten.bernoulli.default", "random"),
        ("aten.no_such_thing.default", "does not exist"),
        ("aten.add.no_such_overload", "does not exist"),
        ("aten.add.__class__", "does not exist"),
        ("aten.__class__.__mro__", "does not exist"),
        ("aten.add", "not of the form"),
        ("prims.add.default", "not of the form"),
        ("os.system.default", "not of the form"),
        ("aten.a b.default", "not of the form"),
    ],
)
def test_operations_that_are_refused(op: str, message: str) -> None:
    with pytest.raises(CaptureError, match=message) as caught:
        Evaluator(one_node(op, Ref("x")), {})
    assert "%y" in str(caught.value) and "user.py:7" in str(caught.value)


def test_attention_with_dropout_is_refused_and_without_is_not() -> None:
    qkv = (Ref("x"),) * 3
    op = "aten.scaled_dot_product_attention.default"
    resolve_op(one_node(op, *qkv, None, 0.0).nodes[0])
    with pytest.raises(CaptureError, match="random"):
        resolve_op(one_node(op, *qkv, None, 0.1).nodes[0])


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({}, "'x' is missing"),
        ({"x": (4, 3), "t": (2,)}, r"'x' has type float32\[4, 3\].*axis 1"),
        ({"x": (4, 2, 1), "t": (2,)}, "'x' has type"),
        ({"x": (4, 2), "t": (3,)}, r"'t' has size 3 in axis 0; expected B with B = 2 from 'x'"),
        ({"x": (5, 2), "t": (2,)}, r"'x' has size 5 in axis 0; expected 2\*B"),
        ({"x": (0, 2), "t": (0,)}, "at least one"),
    ],
)
def test_inputs_that_do_not_fit(inputs: dict[str, tuple[int, ...]], message: str) -> None:
    types = {"x": TensorType((Batch(2), 2), "float32"), "t": TensorType((B,), "float32")}
    with pytest.raises(ObservationError, match=message):
        bind_batch(types, {name: torch.zeros(shape) for name, shape in inputs.items()})


def test_dtypes_are_checked() -> None:
    with pytest.raises(ObservationError, match="float64"):
        evaluate(one_node("aten.neg.default", Ref("x")), {}, {"x": torch.zeros(1, 2, dtype=torch.float64)})


def test_constants_are_checked() -> None:
    graph = Graph({}, {"w": TensorType((2,), "float32")}, (), ("w",))
    assert evaluate(graph, {"w": torch.ones(2)}, {})[0].sum() == 2
    with pytest.raises(CaptureError, match="no value"):
        Evaluator(graph, {})
    with pytest.raises(CaptureError, match=r"float32\[3\]"):
        Evaluator(graph, {"w": torch.ones(3)})


def test_graphs_that_hang_in_the_air() -> None:
    with pytest.raises(CaptureError, match="%z, which nothing"):
        Evaluator(one_node("aten.neg.default", Ref("z")), {})
    with pytest.raises(CaptureError, match=r"no input of its graph has a batch"):
        Evaluator(one_node("aten.zeros.default", (B,), inputs={"x": TensorType((2,), "float32")}), {})
    with pytest.raises(CaptureError, match="no such dtype"):
        Evaluator(one_node("aten.zeros.default", (2,), Enum("dtype", "nn")), {})
    graph = one_node("aten.neg.default", Ref("x"))
    with pytest.raises(CaptureError, match="called %y"):
        Evaluator(Graph(graph.inputs, {}, graph.nodes * 2, ("y",)), {})
    with pytest.raises(CaptureError, match="outputs"):
        Evaluator(Graph(graph.inputs, {}, graph.nodes, ("w",)), {})


def test_a_failing_node_is_named() -> None:
    with pytest.raises(CaptureError, match=r"%y .*user.py:7.* failed for 3 streams"):
        evaluate(one_node("aten.reshape.default", Ref("x"), (B, 5)), {}, {"x": torch.zeros(3, 2)})


def test_stack_traces_are_switched_off_where_torch_has_the_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    config = torch.fx.config
    assert not config.do_not_emit_stack_traces
    with without_stack_traces():
        assert config.do_not_emit_stack_traces
    assert not config.do_not_emit_stack_traces
    monkeypatch.delattr(config, "do_not_emit_stack_traces")  # as torch 2.11 is
    with without_stack_traces():
        assert not hasattr(config, "do_not_emit_stack_traces")
    assert not hasattr(config, "do_not_emit_stack_traces")
