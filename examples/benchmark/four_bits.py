"""One matrix product in fp32, in eight bits and in four: how long each takes, and how far off it is.

    python examples/benchmark/four_bits.py [--rounds 9]

The matrices are those of SmolVLA's and pi0's language models and experts, with random weights. All contestants run in
turn on one thread. Times are the processor's, since the machine may be busy: medians of their ratios to fp32 in the
same round.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import numpy.typing as npt
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from ttscompile.core.four_bits import ATTRIBUTES, pack
from ttscompile.lower.precision import quantize_matrix
from ttscompile.runtimes.onnxruntime.sessions import EXACT_INTEGERS, needs_care

Array = npt.NDArray[Any]
MATRICES = {
    "SmolVLA, language model": (960, 2560),
    "SmolVLA, expert": (720, 2048),
    "pi0, language model": (2048, 2048),
    "pi0, expert": (1024, 4096),
}
ROWS = (1, 50, 241, 600)
OWN = "com.microsoft"


def session(kind: str, constants: dict[str, Array], sizes: tuple[int, int], **attributes: Any) -> Any:
    """A session of one node on one thread, as the onnxruntime runtime opens it."""
    node = helper.make_node(kind, ["x", *constants], ["y"], domain="" if kind == "MatMul" else OWN, **attributes)
    ends = [
        helper.make_tensor_value_info(n, TensorProto.FLOAT, ["M", size]) for n, size in zip("xy", sizes, strict=True)
    ]
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph([node], "product", ends[:1], ends[1:], weights)
    imports = [helper.make_opsetid("", 23), helper.make_opsetid(OWN, 1)]
    model = helper.make_model(graph, opset_imports=imports, ir_version=10)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    if needs_care("int8"):
        options.add_session_config_entry(EXACT_INTEGERS, "1")
    return onnxruntime.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])


def contestants(matrix: Array) -> dict[str, Any]:
    """Sessions by name."""
    rows, columns = matrix.shape
    names = ("w", "scale")
    eight: dict[str, Array] = dict(zip(names, quantize_matrix(matrix), strict=True))
    four: dict[str, Array] = dict(zip(names, pack(matrix), strict=True))
    exact = {**ATTRIBUTES, "accuracy_level": 0}
    return {
        "fp32": session("MatMul", {"w": matrix}, matrix.shape),
        "int8": session("DynamicQuantizeMatMul", eight, matrix.shape),
        "int4": session("MatMulNBits", four, matrix.shape, K=rows, N=columns, **ATTRIBUTES),
        "int4, sums in fp32": session("MatMulNBits", four, matrix.shape, K=rows, N=columns, **exact),
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=9)
    rounds, rng = parser.parse_args().rounds, np.random.default_rng(0)
    for name, (rows, columns) in MATRICES.items():
        matrix = (rng.standard_normal((rows, columns)) / np.sqrt(rows)).astype(np.float32)
        sessions = contestants(matrix)
        for count in ROWS:
            x = rng.standard_normal((count, rows), dtype=np.float32)
            exact, seconds = x @ matrix, {one: list[float]() for one in sessions}
            made = {one: each.run(None, {"x": x})[0] for one, each in sessions.items()}
            for _ in range(rounds):
                for one, each in sessions.items():
                    start = time.process_time()
                    each.run(None, {"x": x})
                    seconds[one].append(time.process_time() - start)
            told = f"{name}, {rows} x {columns}, {count} rows: {np.median(seconds['fp32']) * 1e3:.2f} ms in fp32"
            for one in list(sessions)[1:]:
                ratio = np.median(np.array(seconds[one]) / np.array(seconds["fp32"]))
                off = np.linalg.norm(made[one] - exact) / np.linalg.norm(exact)
                told += f"; {one} {ratio:.2f} of it, {off:.1%} off"
            print(told, flush=True)


if __name__ == "__main__":
    main()
