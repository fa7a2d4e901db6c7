"""Products in eight bits, in the ways that onnxruntime has: how often each takes its floor.

    python examples/benchmark/integer_products.py [--rounds 15]

The matrices are those of SmolVLA's image encoder and language model and of pi0's, with random weights. Three products
read the same numbers, as queries, keys and values do. The floor is the FLOPs at the rate of one large product
(``rate.py``), which is ``dynamic`` with 1,024 rows: the way that is compiled. All contestants take turns on one thread,
in another order in every round, and what they read is in no near cache, as in a call. Times are the processor's, since
the machine may be busy: medians, over the floor of the same run. A cell has the mean of all matrices.
"""

from __future__ import annotations

import argparse
import random
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import onnxruntime
from onnx import NodeProto, TensorProto, helper, numpy_helper
from rate import ProductRate

from ttscompile.lower.precision import quantize_matrix

Array = npt.NDArray[Any]
MATRICES = ((768, 768), (768, 3072), (3072, 768), (960, 2560), (2560, 960), (2048, 4096))
ROWS = (50, 64, 113, 177, 256, 512, 1024)
OWN = "com.microsoft"
PRODUCTS = 3
"""In one graph, as of queries, keys and values."""
EVICTED = 2**24
"""Numbers that are read between two calls: 64 MiB, twice a cache."""
MULTIPLE = 16
"""To which rows are filled up."""
BLOCK = 64
"""Of ``MatMulNBits``, whose weights have eight bits here, too."""

Way = Callable[[Array, Array, int], tuple[list[NodeProto], dict[str, Array]]]
"""Integers ``[K, N]``, their scales ``[N]`` and the rows of the other factor; gives nodes from ``x`` to ``y``, and the
constants that they read."""


def _node(kind: str, given: str, made: str, own: bool = False, **attributes: Any) -> NodeProto:
    return helper.make_node(kind, given.split(), made.split(), domain=OWN if own else "", **attributes)


def dynamic(w: Array, scale: Array, _: int) -> tuple[list[NodeProto], dict[str, Array]]:
    """As it is compiled."""
    return [_node("DynamicQuantizeMatMul", "x w scale", "y", True)], {"w": w, "scale": scale}


def unsigned(w: Array, scale: Array, _: int) -> tuple[list[NodeProto], dict[str, Array]]:
    """The weights as unsigned integers."""
    more = {"w": (w.astype(np.int16) + 128).astype(np.uint8), "zero": np.full(len(scale), 128, np.uint8)}
    return [_node("DynamicQuantizeMatMul", "x w scale zero", "y", True)], {**more, "scale": scale}


def apart(w: Array, scale: Array, _: int) -> tuple[list[NodeProto], dict[str, Array]]:
    """Rounding is an operation of its own; as ``shared`` it is done once for all products."""
    nodes = [_node("DynamicQuantizeLinear", "x", "q s z"), _node("MatMulIntegerToFloat", "q w s scale z", "y", True)]
    return nodes, {"w": w, "scale": scale}


def sums(w: Array, scale: Array, _: int) -> tuple[list[NodeProto], dict[str, Array]]:
    """The sums are given as integers, and scaled afterwards."""
    nodes = [_node("DynamicQuantizeLinear", "x", "q s z"), _node("MatMulInteger", "q w z", "i")]
    nodes += [
        _node("Cast", "i", "f", to=TensorProto.FLOAT),
        _node("Mul", "s scale", "both"),
        _node("Mul", "f both", "y"),
    ]
    return nodes, {"w": w, "scale": scale}


def filled(w: Array, scale: Array, rows: int) -> tuple[list[NodeProto], dict[str, Array]]:
    """Rows are filled up to a multiple."""
    made = {"pads": np.array([0, 0, -rows % MULTIPLE, 0]), "first": np.array([0]), "last": np.array([rows])}
    nodes = [_node("Pad", "x pads", "p"), _node("DynamicQuantizeMatMul", "p w scale", "q", True)]
    return [*nodes, _node("Slice", "q first last first", "y")], {"w": w, "scale": scale, **made}


def halved(w: Array, scale: Array, _: int) -> tuple[list[NodeProto], dict[str, Array]]:
    """Two products of half of the columns each."""
    nodes, made, half = [_node("DynamicQuantizeLinear", "x", "q s z")], dict[str, Array](), len(scale) // 2
    for name, part in {"a": slice(half), "b": slice(half, None)}.items():
        made |= {f"w{name}": np.ascontiguousarray(w[:, part]), f"scale{name}": scale[part]}
        nodes.append(_node("MatMulIntegerToFloat", f"q w{name} s scale{name} z", f"y{name}", True))
    return [*nodes, _node("Concat", "ya yb", "y", axis=1)], made


def blocks(w: Array, scale: Array, _: int) -> tuple[list[NodeProto], dict[str, Array]]:
    """``MatMulNBits`` with eight bits and sums of integers."""
    rows, columns = w.shape
    packed = (w.T.astype(np.int16) + 128).astype(np.uint8).reshape(columns, rows // BLOCK, BLOCK)
    scales = np.repeat(scale, rows // BLOCK)
    sizes = {"K": rows, "N": columns, "bits": 8, "block_size": BLOCK, "accuracy_level": 4}
    return [_node("MatMulNBits", "x w scale", "y", True, **sizes)], {"w": packed, "scale": scales}


WAYS: dict[str, Way] = {
    "dynamic": dynamic,
    "unsigned": unsigned,
    "apart": apart,
    "shared": apart,
    "sums": sums,
    "filled": filled,
    "halved": halved,
    "blocks": blocks,
}


def session(name: str, matrix: Array, rows: int) -> onnxruntime.InferenceSession:
    """Products in one of the ways, on one thread."""
    one, constants = WAYS[name](*quantize_matrix(matrix), rows)
    nodes, weights = list[NodeProto](), list[TensorProto]()
    for number in range(PRODUCTS):
        same = ("x", "q", "s", "z") if name == "shared" else ("x",)
        for node in one[name == "shared" and number > 0 :]:  # the first is that which is shared
            own = NodeProto.FromString(node.SerializeToString())
            for names in (own.input, own.output):
                names[:] = [each if each in same else f"{each}{number}" for each in names]
            nodes.append(own)
        weights += [numpy_helper.from_array(value, f"{each}{number}") for each, value in constants.items()]
    given = helper.make_tensor_value_info("x", TensorProto.FLOAT, [rows, len(matrix)])
    made = [helper.make_tensor_value_info(f"y{n}", TensorProto.FLOAT, [rows, len(matrix[0])]) for n in range(PRODUCTS)]
    graph = helper.make_graph(nodes, "products", [given], made, weights)
    imports = [helper.make_opsetid("", 21), helper.make_opsetid(OWN, 1)]
    model = helper.make_model(graph, opset_imports=imports, ir_version=10)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    # Any would put together what is apart.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    return onnxruntime.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])


def measured(matrix: Array, rows: int, rounds: int, product: ProductRate) -> dict[str, float]:
    """How often products take their floor, by the way; their results are near the exact one."""
    x = np.random.default_rng(rows).standard_normal((rows, len(matrix)), np.float32)
    sessions = {name: session(name, matrix, rows) for name in WAYS}
    exact, seconds = x @ matrix, {name: list[float]() for name in WAYS}
    for name, one in sessions.items():
        off = np.linalg.norm(one.run(None, {"x": x})[0] - exact) / np.linalg.norm(exact)
        assert off < 0.03, f"{name}: {off:.1%} off"
    evicted, order = np.zeros(EVICTED, np.float32), list(sessions.items())
    for _ in range(rounds):
        product.run()
        random.shuffle(order)
        for name, one in order:
            evicted += 1
            start = time.process_time()
            one.run(None, {"x": x})
            seconds[name].append(time.process_time() - start)
    least = product.seconds(PRODUCTS * 2 * rows * matrix.size)
    return {name: statistics.median(own) / least for name, own in seconds.items()}


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=15)
    rounds, rng = parser.parse_args().rounds, np.random.default_rng(0)
    print(f"| rows | {' | '.join(WAYS)} |\n| --- |{' --- |' * len(WAYS)}")
    for rows in ROWS:
        found: dict[str, list[float]] = {name: [] for name in WAYS}
        for shape in MATRICES:
            product = ProductRate("int8")
            product.run()
            matrix = (rng.standard_normal(shape) / np.sqrt(shape[0])).astype(np.float32)
            for name, ratio in measured(matrix, rows, rounds, product).items():
                found[name].append(ratio)
        print(f"| {rows} | {' | '.join(f'{statistics.mean(own):.2f}' for own in found.values())} |", flush=True)


if __name__ == "__main__":
    main()
