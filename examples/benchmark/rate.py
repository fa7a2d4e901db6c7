"""What the arithmetic of a large network takes alone: its FLOPs, at the rate of one large product.

``floor.py`` computes the blocks of a network back to back. A network of hundreds of millions of weights is not opened
twice for that. Here one product of a vision transformer, 1,024 rows by 768 by 3,072, says what onnxruntime reaches on
one thread of this core, or on several: in fp32, and in eight bits, with everything that is turned into integers and
back. Whoever measures runs it in turn with the contestants. Nothing else is in the floor, so that small products, those
that stay fp32 and all that is no product are what a measured time has above it.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import onnxruntime
from onnx import ModelProto, TensorProto, helper, numpy_helper

from ttscompile.lower.precision import quantize_model
from ttscompile.runtimes.onnxruntime.sessions import SPIN_US

ROWS, WIDTH, COLUMNS = 1024, 768, 3072

Clock = Callable[[], float]


class ProductRate:
    """FLOP/s of one product in a precision.

    Args:
        precision: ``fp32`` or ``int8``.
        threads: that compute it.
        clock: whose seconds count: the processor's, or with several threads the clock's.

    Attributes:
        model: the product.
    """

    def __init__(self, precision: str, threads: int = 1, clock: Clock = process_time) -> None:
        rng = np.random.default_rng(0)
        weights = {"w": rng.standard_normal((WIDTH, COLUMNS), dtype=np.float32)}
        model = helper.make_model(
            helper.make_graph(
                [helper.make_node("MatMul", ["x", "w"], ["y"], "product")],
                "product",
                [helper.make_tensor_value_info("x", TensorProto.FLOAT, [ROWS, WIDTH])],
                [helper.make_tensor_value_info("y", TensorProto.FLOAT, [ROWS, COLUMNS])],
                [TensorProto(name="w", dims=(WIDTH, COLUMNS), data_type=TensorProto.FLOAT)],
            ),
            opset_imports=[helper.make_opsetid("", 21)],
            ir_version=10,
        )
        if precision == "int8":
            model, weights = quantize_model(model, weights)
        self.model = model
        self._session, self._clock = session(model, weights, threads=threads), clock
        self._given = {"x": rng.standard_normal((ROWS, WIDTH), dtype=np.float32)}
        self._seconds: list[float] = []

    def run(self) -> None:
        """Once."""
        start = self._clock()
        self._session.run(None, self._given)
        self._seconds.append(self._clock() - start)

    def seconds(self, flops: float) -> float:
        """What so many FLOPs take, by the median of the runs but the first."""
        return flops / (2 * ROWS * WIDTH * COLUMNS) * statistics.median(self._seconds[1:])


def session(
    model: ModelProto, weights: dict[str, Any], profile: Path | None = None, threads: int = 1
) -> onnxruntime.InferenceSession:
    """Initializers get their values from ``weights``. ``profile`` is how its profile's name begins."""
    for tensor in model.graph.initializer:
        if tensor.name in weights:
            tensor.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(weights[tensor.name]), tensor.name))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.spin_duration_us", str(SPIN_US))  # or the next calls pay for it
    if profile is not None:
        options.enable_profiling, options.profile_file_prefix = True, str(profile)
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def rates(threads: int = 1, clock: Clock = process_time) -> dict[str, ProductRate]:
    """One for each precision."""
    return {precision: ProductRate(precision, threads, clock) for precision in ("fp32", "int8")}


def run_all(products: Iterable[ProductRate]) -> None:
    """Each three times."""
    for product in products:
        for _ in range(3):
            product.run()
