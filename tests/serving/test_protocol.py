"""Messages of the server, without one."""

from __future__ import annotations

import json
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ttscompile import ObservationSpec
from ttscompile.errors import ProtocolError
from ttscompile.runtimes.executor.window import FrameSpec
from ttscompile.serving.protocol import read_arrays, read_frame, read_request


def test_requests_are_read_and_frames_converted() -> None:
    request = read_request('{"id": 1, "method": "observe", "obs": {"image": [[255, 0]]}, "t": 2}')
    assert (request.id, request.method, request.params["t"]) == (1, "observe", 2)
    frames = FrameSpec.of({"image": ObservationSpec((2, 1, 2), dtype="uint8")}, 2)
    image = read_arrays(request.params["obs"], frames.specs)["image"]
    assert (image.dtype.name, image.tolist()) == ("uint8", [[255, 0]])
    for wrong in ([[256, 0]], [[-1, 0]], [[1.5, 0]], [["1", 0]], [[10**30, 0]]):
        with pytest.raises(ProtocolError, match="image"):
            read_arrays({"image": wrong}, frames.specs)
    beyond = read_arrays({"obs": [1e300]}, {"obs": ObservationSpec((1, 1))})["obs"]
    assert beyond.tolist() == [np.inf]  # without a warning; ``observe`` refuses it


def test_a_mask_is_of_true_and_false() -> None:
    """LeRobot's language policies have one; 0 and 1 mean the same, and other numbers nothing."""
    frames = FrameSpec.of({"mask": ObservationSpec((3,), dtype="bool", window=False)}, 1)
    for given_as in ([True, False, True], [1, 0, 1], [1, False, True]):
        mask = read_arrays({"mask": given_as}, frames.specs)["mask"]
        assert (mask.dtype.name, mask.tolist()) == ("bool", [True, False, True])
    for wrong in ([2, 0, 1], [-1, 0, 1], [0.5, 0.0, 1.0], ["true", "false", "true"]):
        with pytest.raises(ProtocolError, match="mask"):
            read_arrays({"mask": wrong}, frames.specs)
    with pytest.raises(ProtocolError, match="numbers that are float32"):
        read_arrays({"obs": [True, False]}, {"obs": ObservationSpec((2,), window=False)})


def test_a_frame_may_have_a_task() -> None:
    specs = {"obs": ObservationSpec((2,), window=False), "task": ObservationSpec((1,), window=False)}
    frame = read_frame({"obs": [1, 2], "task": "pick"}, {"obs": specs["obs"]})
    assert (np.asarray(frame["obs"]).tolist(), frame["task"]) == ([1, 2], "pick")
    assert np.asarray(read_frame({"obs": [1, 2], "task": [3.0]}, specs)["task"]).tolist() == [3], "one may be numbers"
    with pytest.raises(ProtocolError, match="a task has at most 4096 characters; found 4097"):
        read_frame({"task": "a" * 4097}, {})


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)
FRAMES = FrameSpec.of({"obs": ObservationSpec((2, 3)), "image": ObservationSpec((2, 2, 2), dtype="uint8")}, 2)
DTYPES = JSON | st.sampled_from(["f4", "O", "U3", "M8[s]", ",", "2)", "(1,", "a5"])
SHAPES = JSON | st.lists(st.integers(0, 10**30) | st.just(float("inf")), max_size=3)
PACKED = st.fixed_dictionaries({"dtype": DTYPES, "shape": SHAPES, "base64": JSON})


@given(st.text() | st.binary() | JSON.map(json.dumps))
def test_anything_is_a_request_or_a_protocol_error(message: str | bytes) -> None:
    with suppress(ProtocolError):
        read_request(message)


@given(
    st.sampled_from(["info", "observe", "action", "reset", "statistics"]),
    st.dictionaries(st.sampled_from(["obs", "t", "timeout", "seed"]), JSON, max_size=3),
    st.dictionaries(st.sampled_from(["obs", "image", "other", "task"]), JSON | PACKED, max_size=3),
)
def test_any_parameters_are_taken_or_a_protocol_error(method: str, params: dict, obs: dict) -> None:  # type: ignore[type-arg]
    message = json.dumps({"method": method, **params, **({"obs": obs} if "obs" in params else {})})
    with suppress(ProtocolError):
        request = read_request(message)
        if method == "observe":
            read_frame(request.params["obs"], FRAMES.specs)
