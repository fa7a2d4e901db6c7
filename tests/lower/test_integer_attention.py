"""Attention in integers: exactly the quantised one, close to float32, head by head, and only where that is faster."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from onnx import ModelProto, NodeProto, TensorProto
from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info

from tests.lower.sessions import Array, session
from ttscompile.ir.pieces import CONDITION
from ttscompile.lower.integer_attention import FEWEST, HEADS
from ttscompile.lower.precision import lower_precision, quantize_model

COUNT, CHANNELS = 3, 8
WIDTH = COUNT * CHANNELS
PLAIN: dict[str, Any] = {"q_num_heads": COUNT, "kv_num_heads": COUNT}
PRODUCTS = ("DynamicQuantizeMatMul", "MatMulIntegerToFloat")
WEIGHTS = {"w": np.eye(WIDTH, dtype=np.float32)}


def model_of(node: NodeProto, tokens: Mapping[str, int | str], batch: int | str = "B") -> ModelProto:
    """A model from the inputs of ``node``, ``[batch, tokens, WIDTH]`` each, to ``y``, which is an eight-bit product.

    Only a model that has a product by constants gets eight bits.
    """
    inputs = [make_tensor_value_info(name, TensorProto.FLOAT, [batch, n, WIDTH]) for name, n in tokens.items()]
    empty = [TensorProto(name="w", dims=WEIGHTS["w"].shape, data_type=TensorProto.FLOAT)]
    nodes = [node, make_node("MatMul", ["q", "w"], ["product"], "product")]
    outputs = [make_tensor_value_info(name, TensorProto.FLOAT, None) for name in ("y", "product")]
    graph = make_graph(nodes, "g", inputs, outputs, empty)
    return make_model(graph, opset_imports=[make_opsetid("", 23)], ir_version=10)


def attention(**attributes: Any) -> NodeProto:
    return make_node("Attention", ["q", "k", "v"], ["y"], "n0", **PLAIN | attributes)


def run(model: ModelProto, constants: Mapping[str, Array], given: Mapping[str, Array]) -> Array:
    result: Array = session(model, constants, exact=False).run(["y"], dict(given))[0]
    return result


def both(queries: int, keys: int, given: Mapping[str, Array], **attributes: Any) -> tuple[Array, Array]:
    """What integers and float32 make of it."""
    model = model_of(attention(**attributes), {"q": queries, "k": keys, "v": keys})
    made, constants = quantize_model(model, WEIGHTS)
    kinds = {node.op_type for node in made.graph.node}
    assert HEADS in kinds and "Attention" not in kinds
    return run(made, {**WEIGHTS, **constants}, given), run(model, WEIGHTS, given)


def quantised(q: Array, k: Array, v: Array, scale: float) -> Array:
    """One head in float64 with what its integers stand for; query ``[T, C]``, key and value ``[S, C]``."""
    low, high = min(0.0, float(q.min())), max(0.0, float(q.max()))
    step = np.float32((np.float32(high) - np.float32(low)) / np.float32(255))
    zero = np.rint(-low / step)
    query = (np.clip(np.rint(q / step) + zero, 0, 255) - zero) * step
    key, value = k - k.mean(axis=0), v - v.mean(axis=0)
    steps = np.abs(key).max(axis=1, keepdims=True) / 64, np.abs(value).max() / 64
    key, value = (np.rint(each / step) * step for each, step in zip((key, value), steps, strict=True))
    scores = query.astype("f8") @ key.T.astype("f8") * scale
    shares = np.exp(scores - scores.max(axis=1, keepdims=True))
    shares /= shares.sum(axis=1, keepdims=True)
    most = shares.max(axis=1, keepdims=True) / 255
    result: Array = np.rint(shares / most) * most @ value + v.mean(axis=0)
    return result


def heads(x: Array) -> Array:
    return x.reshape(*x.shape[:2], COUNT, CHANNELS).transpose(0, 2, 1, 3)


def drawn(kind: str, queries: int, keys: int, batch: int = 2) -> dict[str, Array]:
    """Random queries, keys and values, whose means are not zero, and whose heads differ in size.

    ``flat`` scores are nearly equal, ``peaked`` ones leave most keys without a share.
    """
    draw = np.random.default_rng(queries + keys)
    size = {"flat": 0.05, "usual": 1.0, "peaked": 4.0}[kind]
    sizes = {"q": (queries, size), "k": (keys, size), "v": (keys, 1.0)}
    own = np.repeat(10.0 ** np.arange(COUNT) / 10, CHANNELS)
    return {
        name: ((draw.standard_normal((batch, tokens, WIDTH)) + 0.5) * many * (own if name == "v" else 1)).astype("f4")
        for name, (tokens, many) in sizes.items()
    }


@pytest.mark.parametrize("kind", ["flat", "usual", "peaked"])
@pytest.mark.parametrize(("queries", "keys", "given"), [(256, 300, {}), (301, 256, {"scale": 0.2})])
def test_it_is_exactly_the_quantised_attention_and_near_to_float32(
    kind: str, queries: int, keys: int, given: dict[str, float]
) -> None:
    inputs = drawn(kind, queries, keys)
    found, exact = both(queries, keys, inputs, **given)
    q, k, v = (heads(inputs[name]) for name in "qkv")
    scale = given.get("scale", CHANNELS**-0.5)
    expected = np.array([[quantised(*one, scale) for one in zip(*b, strict=True)] for b in zip(q, k, v, strict=True)])
    for head in range(COUNT):  # each has a size of its own
        made, close, true = heads(found)[:, head], expected[:, head], heads(exact)[:, head]
        size = np.abs(v[:, head] - v[:, head].mean(axis=1, keepdims=True)).max()
        # Another rounding of float32 may move a key's number by one, which few queries see.
        assert np.abs(made - close).max() < 0.04 * size
        assert np.abs(made - close).mean() < 2e-4 * size
        assert 0 < np.abs(made - true).mean() < 0.01 * size


@pytest.mark.parametrize("flat", [True, False])
def test_some_queries_of_many(flat: bool) -> None:
    """A tower for some of its tokens: what is decided for all of them, for any number of them."""
    inputs = drawn("usual", FEWEST, FEWEST, batch=1)

    def model(queries: int | str) -> ModelProto:
        tokens = {"q": queries, "k": FEWEST, "v": FEWEST}
        if flat:
            return model_of(attention(), tokens, batch=1)
        made = model_of(make_node("Attention", list("qkv"), ["y"], "n0"), tokens, batch=1)
        kinds = [make_tensor_value_info(n, TensorProto.FLOAT, [1, COUNT, tokens[n], CHANNELS]) for n in "qkv"]
        del made.graph.input[:]
        made.graph.input.extend([*kinds, make_tensor_value_info("x", TensorProto.FLOAT, [1, WIDTH])])
        made.graph.node[1].input[0] = "x"
        return made

    given = inputs if flat else {name: heads(value) for name, value in inputs.items()}
    some, constants = quantize_model(model("B"), WEIGHTS, size=FEWEST)
    assert HEADS in {node.op_type for node in some.graph.node}
    whole, _ = quantize_model(model(FEWEST), WEIGHTS)
    extra = {} if flat else {"x": np.zeros((1, WIDTH), np.float32)}
    for count in (FEWEST, 5):
        few = {**given, "q": given["q"][..., :count, :], **extra}
        found = run(some, {**WEIGHTS, **constants}, few)
        if count == FEWEST:
            np.testing.assert_array_equal(found, run(whole, {**WEIGHTS, **constants}, few))
        exact = run(model("B"), WEIGHTS, few)
        assert found.shape == exact.shape
        assert 0 < np.abs(found - exact).mean() < 0.02 * np.abs(exact).mean()


def test_a_tower_and_its_form_for_some_tokens_have_it_both() -> None:
    """Else a refresh would give other numbers than the tower, and take as long as in fp32."""
    whole, some = (model_of(attention(), {"q": n, "k": FEWEST, "v": FEWEST}, batch=1) for n in (FEWEST, "B"))
    kept = [make_tensor_value_info("k.kept", TensorProto.FLOAT, [FEWEST, 1, WIDTH]), *some.graph.input]
    del some.graph.input[:]
    some.graph.input.extend(kept)
    some.graph.node.append(make_node("Identity", ["k.kept"], ["k.kept.new"]))
    some.graph.output.append(make_tensor_value_info("k.kept.new", TensorProto.FLOAT, [FEWEST, 1, WIDTH]))
    made, _, _ = lower_precision({"frame_00": whole, "tokens_00": some}, WEIGHTS, "int8", ["frame_00"])
    for name in ("frame_00", "tokens_00"):
        assert HEADS in {node.op_type for node in made[name].graph.node}


def test_an_axis_of_heads_makes_no_difference() -> None:
    inputs = drawn("usual", FEWEST, FEWEST)
    node = make_node("Attention", ["q", "k", "v"], ["y"], "n0")
    ends = [make_tensor_value_info(name, TensorProto.FLOAT, ["B", COUNT, FEWEST, CHANNELS]) for name in "qkv"]
    model = model_of(node, dict.fromkeys("qkv", FEWEST))
    del model.graph.input[:]
    model.graph.input.extend([*ends, make_tensor_value_info("x", TensorProto.FLOAT, ["B", WIDTH])])
    model.graph.node[1].input[0] = "x"
    made, constants = quantize_model(model, WEIGHTS)
    assert HEADS in {each.op_type for each in made.graph.node}
    given = {name: heads(value) for name, value in inputs.items()}
    found = session(made, {**WEIGHTS, **constants}).run(["y"], {**given, "x": np.zeros((2, WIDTH), np.float32)})[0]
    np.testing.assert_array_equal(found, heads(both(FEWEST, FEWEST, inputs)[0]))


def test_older_versions_of_onnxruntime_open_it() -> None:
    """1.25 to 1.29 end where a product leaves out the zero point, and 1.23 has no QuantizeLinear of this opset."""
    model = model_of(attention(), {"q": FEWEST, "k": FEWEST, "v": FEWEST})
    graph = quantize_model(model, WEIGHTS)[0].graph
    bodies = [each.g for node in graph.node for each in node.attribute if each.name == "body"]
    nodes = [node for one in (graph, *bodies) for node in one.node]
    given = {kind: {len(node.input) for node in nodes if node.op_type == kind} for kind in PRODUCTS}
    assert given == {"DynamicQuantizeMatMul": {4}, "MatMulIntegerToFloat": {6}}
    assert {node.domain for node in nodes if node.op_type == "QuantizeLinear"} == {"com.microsoft"}


def test_streams_and_heads_do_not_see_each_other() -> None:
    inputs = drawn("usual", FEWEST, FEWEST)
    together = both(FEWEST, FEWEST, inputs)[0]
    alone = [both(FEWEST, FEWEST, {name: value[b : b + 1] for name, value in inputs.items()})[0] for b in range(2)]
    np.testing.assert_array_equal(together, np.concatenate(alone))
    loud = {name: value.copy() for name, value in inputs.items()}
    for value in loud.values():
        value[:, :, :CHANNELS] *= 1000
    np.testing.assert_array_equal(both(FEWEST, FEWEST, loud)[0][:, :, CHANNELS:], together[:, :, CHANNELS:])


def test_nothing_saturates_on_any_processor() -> None:
    """The largest sums of two products of a query with a key: keys are as far from their mean as integers tell."""
    q = np.full((1, FEWEST, WIDTH), 3.0, np.float32)
    k = np.repeat(np.tile(np.array([-1, 1], np.float32), FEWEST // 2), WIDTH).reshape(1, FEWEST, WIDTH)
    found, exact = both(FEWEST, FEWEST, {"q": q, "k": k, "v": 2 * k + 1}, scale=0.01)
    np.testing.assert_allclose(found, exact, atol=0.01)
    assert np.ptp(k) > 0 and exact.mean() > 1.2, "keys that all score alike tell nothing"


@pytest.mark.parametrize("value", [0.0, 7.5])
def test_equal_tokens_attend_to_their_value(value: float) -> None:
    inputs = {name: np.full((1, FEWEST, WIDTH), value, np.float32) for name in "qkv"}
    np.testing.assert_allclose(both(FEWEST, FEWEST, inputs)[0], value, rtol=1e-6)


@pytest.mark.parametrize(
    ("node", "tokens"),
    [
        (attention(), {"q": FEWEST, "k": FEWEST - 1, "v": FEWEST - 1}),
        (attention(), {"q": FEWEST - 1, "k": FEWEST, "v": FEWEST}),
        (attention(is_causal=1), dict.fromkeys("qkv", FEWEST)),
        (attention(softcap=3.0), dict.fromkeys("qkv", FEWEST)),
        (attention(kv_num_heads=1), {"q": FEWEST, "k": FEWEST, "v": FEWEST}),
        (attention(), {"q": FEWEST, "k": "S", "v": "S"}),
        (make_node("Attention", ["q", "k", "v", "mask"], ["y"], "n0", **PLAIN), dict.fromkeys("qkv", FEWEST)),
    ],
    ids=["few keys", "few queries", "causal", "capped", "heads that share keys", "unknown size", "mask"],
)
def test_what_is_slower_or_something_else_stays_as_it_is(node: NodeProto, tokens: Mapping[str, int | str]) -> None:
    made, constants = quantize_model(model_of(node, tokens), WEIGHTS)
    assert constants and node in made.graph.node
    assert HEADS not in {each.op_type for each in made.graph.node}


def test_the_notes_count_it() -> None:
    model = model_of(attention(), dict.fromkeys("qkv", FEWEST))
    made, _, notes = lower_precision({CONDITION: model}, WEIGHTS, "int8", (CONDITION,))
    assert notes[0].startswith(f"int8: 1 matrices of {CONDITION}") and notes[0].endswith(", and 1 attentions")
    assert (
        made[CONDITION].SerializeToString()
        == lower_precision({CONDITION: model}, WEIGHTS, "int8", (CONDITION,))[0][CONDITION].SerializeToString()
    )
