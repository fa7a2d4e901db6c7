"""Models whose constants have no data, run with those that are given."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
from onnx import ModelProto

from ttscompile.runtimes.onnxruntime.sessions import EXACT_INTEGERS

Array = npt.NDArray[Any]


def session(model: ModelProto, constants: Mapping[str, Array], exact: bool = True) -> onnxruntime.InferenceSession:
    """A session on one thread; ``exact``: integers are summed exactly on every processor."""
    filled = ModelProto()
    filled.CopyFrom(model)
    for tensor in filled.graph.initializer:
        if not tensor.raw_data:
            value = constants[tensor.name]
            assert (tuple(tensor.dims), onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type)) == (
                value.shape,
                value.dtype,
            )
            tensor.raw_data = np.ascontiguousarray(value).tobytes()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry(EXACT_INTEGERS, str(int(exact)))
    return onnxruntime.InferenceSession(filled.SerializeToString(), options, providers=["CPUExecutionProvider"])
