"""``select_action`` and ``predict_action_chunk``: LeRobot's queues, on any policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from ttscompile import Noise
from ttscompile.artifact import Artifact
from ttscompile.config import ObservationSpec
from ttscompile.errors import ObservationError
from ttscompile.runtimes.policy import CompiledPolicy, load
from ttscompile.runtimes.queues import Queues, is_window

SPECS = {"observation.state": ObservationSpec((3, 2)), "tokens": ObservationSpec((4,), dtype="int64", window=False)}


def frame(value: float, streams: int = 1) -> dict[str, Any]:
    """One frame, with a key that is no observation."""
    state, tokens = np.full((streams, 2), value, np.float32), np.full((streams, 4), int(value))
    return {"observation.state": state, "tokens": tokens, "task": ["push"]}


def window(queues: Queues) -> list[float]:
    """The frames of the first stream, one number each."""
    state = queues.observation()["observation.state"]
    assert state.shape[1:] == (3, 2)
    return state[0, :, 0].tolist()  # type: ignore[no-any-return]


def test_the_first_frame_stands_for_those_before_it() -> None:
    queues = Queues(SPECS)
    seen = []
    for value in (1, 2, 3, 4):
        queues.push(frame(value))
        seen.append(window(queues))
    assert seen == [[1, 1, 1], [1, 1, 2], [1, 2, 3], [2, 3, 4]]
    assert queues.observation()["tokens"].tolist() == [[4, 4, 4, 4]]
    assert set(queues.observation()) == set(SPECS)
    queues.reset()
    queues.push(frame(9, streams=2))
    assert window(queues) == [9, 9, 9]


def test_frames_are_the_queues_own() -> None:
    """Robots reuse their buffers."""
    queues, given = Queues(SPECS), frame(1)
    queues.push(given)
    given["observation.state"][:] = 7
    assert window(queues) == [1, 1, 1]


def test_actions_come_one_by_one() -> None:
    queues = Queues(SPECS)
    assert queues.empty
    queues.extend(np.arange(8, dtype=np.float32).reshape(2, 2, 2))
    assert [queues.pop().tolist() for _ in range(2)] == [[[0, 1], [4, 5]], [[2, 3], [6, 7]]]
    assert queues.empty


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tokens": None}, r"lacks \['tokens'\]"),
        (
            {"observation.state": np.zeros((1, 3, 2), np.float32)},
            r"must be float32 \[B, 2\]; found float32 \[1, 3, 2\]",
        ),
        ({"observation.state": np.zeros(2, np.float32)}, "needs a first axis of 1"),
        ({"observation.state": np.zeros((1, 2))}, "found float64"),
        ({"observation.state": np.full((1, 2), np.nan, np.float32)}, "must be finite"),
        ({"observation.state": np.zeros((2, 2), np.float32)}, "different numbers of streams"),
        ({"observation.state": [[0, 0]]}, "expected a numpy array or a torch tensor"),
    ],
)
def test_a_bad_frame_changes_nothing(change: dict[str, Any], message: str) -> None:
    queues = Queues(SPECS)
    queues.push(frame(1))
    bad = {key: value for key, value in (frame(2) | change).items() if value is not None}
    with pytest.raises(ObservationError, match=message):
        queues.push(bad)
    assert window(queues) == [1, 1, 1]
    with pytest.raises(ObservationError, match="before"):
        queues.push(frame(2, streams=3))


def test_windows_are_told_from_frames() -> None:
    assert not is_window(frame(1), SPECS)
    assert is_window({"observation.state": np.zeros((1, 3, 2)), "tokens": np.zeros((1, 4))}, SPECS)


@pytest.fixture
def policy(toy_artifact: Artifact) -> CompiledPolicy:
    return load(toy_artifact.path, seed=0)


def some_noise(streams: int = 1) -> Noise:
    rng = np.random.default_rng(0)
    return Noise(rng.standard_normal((streams, 3, 2), np.float32), rng.standard_normal((5, streams, 3, 2), np.float32))


def test_select_action_computes_when_the_chunk_is_used_up(policy: CompiledPolicy) -> None:
    """Two actions a chunk: calls 1 and 3 compute, and what they give is ``predict_action``'s chunk."""
    obs = {"obs": torch.tensor([[0.3, -1.2]])}
    chunk = policy.predict_action(obs, noise=some_noise(), plan="dense")["action"]
    assert chunk.shape == (1, 2, 2)
    policy.reset()
    found, reports = [], []
    for _ in range(3):
        found.append(policy.select_action(obs | {"action": None}, noise=some_noise(), plan="dense"))
        reports.append(policy.last_report)
    assert reports[0] is reports[1] is not reports[2]
    assert isinstance(found[0], torch.Tensor)
    assert torch.equal(torch.stack(found[:2], dim=1), chunk) and torch.equal(found[2], chunk[:, 0])
    whole = policy.predict_action_chunk(obs, noise=some_noise(), plan="dense")
    assert torch.equal(whole, chunk)
    report = policy.last_report
    assert torch.equal(policy.select_action(obs), chunk[:, 1])  # the queue of actions was left alone
    assert policy.last_report is report


def test_reset_drops_actions_and_streams(policy: CompiledPolicy) -> None:
    policy.select_action({"obs": np.zeros((1, 2), np.float32)}, noise=some_noise(), plan="dense")
    first = policy.last_report
    with pytest.raises(ObservationError, match=r"only after reset\(\)"):
        policy.select_action({"obs": np.zeros((2, 2), np.float32)})
    policy.reset()
    action = policy.select_action({"obs": np.zeros((2, 2), np.float32)}, noise=some_noise(2), plan="dense")
    assert action.shape == (2, 2) and policy.last_report is not first
