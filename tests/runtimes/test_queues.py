"""``select_action`` and ``predict_action_chunk``: LeRobot's queues, on any policy."""

import time
from typing import Any

import numpy as np
import pytest
import torch

from ttscompile.artifact import Artifact
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import IllegalPlanError, NonFiniteActionsError, ObservationError
from ttscompile.runtimes.arrays import check_observation, read_observation
from ttscompile.runtimes.load import load
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.queues import Queues, is_window

from .toys import some_noise

SPECS = {"observation.state": ObservationSpec((3, 2)), "tokens": ObservationSpec((4,), dtype="int64", window=False)}


def frame(value: float, streams: int = 1) -> dict[str, Any]:
    """One frame, with a key that is no observation."""
    state, tokens = np.full((streams, 2), value, np.float32), np.full((streams, 4), int(value))
    return {"observation.state": state, "tokens": tokens, "task": ["push"]}


def taken(batch: dict[str, Any]) -> dict[str, np.ndarray]:
    """A batch as ``select_action`` hands it on."""
    return read_observation(batch, SPECS, others=True)[0]


def push(queues: Queues, batch: dict[str, Any]) -> dict[str, Any]:
    """Take a frame; the window after it."""
    queues.keep(queues.after(taken(batch)))
    return queues.observation(queues._frames)


def window(queues: Queues) -> list[float]:
    """The frames of the first stream, one number each."""
    state = queues.observation(queues._frames)["observation.state"]
    assert state.shape[1:] == (3, 2)
    return state[0, :, 0].tolist()


@pytest.mark.parametrize(
    ("shape", "remedy"),
    [((1, 2), "Give the last 3 frames of each stream"), ((1, 1, 2), "last 3 frames"), ((1, 6, 2), "last 3 frames"),
     ((1, 3, 3), None), ((1, 6), None), ((0, 3, 2), None)],
)  # fmt: skip
def test_another_number_of_frames_is_refused_with_advice(shape: tuple[int, ...], remedy: str | None) -> None:
    with pytest.raises(ObservationError, match=r"wrong shape: expected float32 \[B, 3, 2\]") as refused:
        check_observation({"obs": np.zeros(shape, np.float32)}, {"obs": SPECS["observation.state"]})
    assert ("frames" in str(refused.value)) == (remedy is not None)
    assert remedy is None or remedy in str(refused.value)
    queues = Queues(SPECS)
    with pytest.raises(ObservationError, match=r"expected float32 \[B, 2\].*give the newest alone, \[:, -1\]"):
        queues.after(frame(1) | {"observation.state": np.zeros((1, 3, 2), np.float32)})


def test_the_first_frame_stands_for_those_before_it() -> None:
    queues = Queues(SPECS)
    seen = []
    for value in (1, 2, 3, 4):
        push(queues, frame(value))
        seen.append(window(queues))
    assert seen == [[1, 1, 1], [1, 1, 2], [1, 2, 3], [2, 3, 4]]
    after = push(queues, frame(5))
    assert after["tokens"].tolist() == [[5, 5, 5, 5]] and set(after) == set(SPECS)
    queues.reset()
    push(queues, frame(9, streams=2))
    assert window(queues) == [9, 9, 9]


def test_frames_are_the_queues_own() -> None:
    """Robots reuse their buffers."""
    queues, given = Queues(SPECS), frame(1)
    push(queues, given)
    given["observation.state"][:] = 7
    assert window(queues) == [1, 1, 1]


def test_actions_come_one_by_one() -> None:
    queues = Queues(SPECS)
    assert queues.queued == 0
    queues.extend(np.arange(8, dtype=np.float32).reshape(2, 2, 2))
    assert queues.queued == 2
    assert [queues.pop().tolist() for _ in range(2)] == [[[0, 1], [4, 5]], [[2, 3], [6, 7]]]
    assert queues.queued == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tokens": None}, r"missing: \['tokens'\]"),
        (
            {"observation.state": np.zeros((1, 3, 2), np.float32)},
            r"expected float32 \[B, 2\]; found float32 \[1, 3, 2\]",
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
    push(queues, frame(1))
    queues.after(taken(frame(5)))  # not kept
    bad = {key: value for key, value in (frame(2) | change).items() if value is not None}
    with pytest.raises(ObservationError, match=message):
        queues.after(taken(bad))
    assert window(queues) == [1, 1, 1]
    with pytest.raises(ObservationError, match="before"):
        queues.after(taken(frame(2, streams=3)))


IMAGE = ObservationSpec((2, 3, 8, 9), bounds=(0.0, 1.0))
RNG = np.random.default_rng(0)
PIXELS = RNG.integers(0, 256, (1, 3, 8, 9)).astype(np.uint8)


@pytest.mark.parametrize("bytes_per_pixel", ["as float", "as they are", "normalised", "channels last"])
def test_images_are_what_the_policy_was_trained_on(bytes_per_pixel: str) -> None:
    """The same picture as 0..255, as bytes, as -1..1 and with its channels last, in a window and as one frame."""
    good = PIXELS.astype(np.float32) / 255
    wrong: dict[str, tuple[np.ndarray, str]] = {
        "as float": (PIXELS.astype(np.float32), r"'camera' is an image .* of 0 to 1; found 0 to 25\d\. Divide by 255,"),
        "as they are": (PIXELS, r"uint8.*Divide by 255, channels first: image\.astype\(np\.float32\) / 255\."),
        "normalised": (good * 2 - 1, r"'camera' .* of 0 to 1; found -\S+ to \S+\. Give what the camera measures"),
        "channels last": (np.moveaxis(good, 1, -1), r"np\.moveaxis\(image, -1, -3\)"),
    }
    bad, message = wrong[bytes_per_pixel]
    with pytest.raises(ObservationError, match=message):
        check_observation({"camera": np.stack((bad, bad), 1)}, {"camera": IMAGE})
    with pytest.raises(ObservationError, match=message):
        Queues({"camera": IMAGE}).after({"camera": bad})
    cubic = good * 1.1 - 0.05  # what a cubic filter may overshoot by
    check_observation({"camera": np.stack((good, cubic), 1)}, {"camera": IMAGE})
    Queues({"camera": IMAGE}).after({"camera": cubic})


def test_bounds_of_vectors_are_statistics_and_bounds_of_tokens_are_not() -> None:
    """A robot may be where it never was in training; a token that does not exist is refused in a frame, too."""
    state = ObservationSpec((2, 1), bounds=((0.0,), (1.0,)))
    assert not state.image and IMAGE.image and not ObservationSpec((2, 3, 8, 9)).image
    assert not ObservationSpec((3, 8, 9), bounds=(0.0, 1.0)).image  # three frames of a matrix
    assert ObservationSpec((3, 8, 9), bounds=(0.0, 1.0), window=False).image
    check_observation({"state": np.full((1, 2, 1), 7.0, np.float32)}, {"state": state})
    tokens = ObservationSpec((4,), dtype="int64", window=False, bounds=(0.0, 9.0))
    with pytest.raises(ObservationError, match="integers of 0 to 9; found 10 to 10"):
        Queues({"tokens": tokens}).after({"tokens": np.full((1, 4), 10)})


def test_the_check_of_two_cameras_takes_less_than_a_millisecond() -> None:
    spec = ObservationSpec((2, 3, 96, 96), bounds=(0.0, 1.0))
    obs = {name: RNG.random((1, 2, 3, 96, 96), np.float32) for name in ("left", "right")}
    times = []
    for _ in range(30):
        begun = time.perf_counter()
        check_observation(obs, dict.fromkeys(obs, spec))
        times.append(time.perf_counter() - begun)
    assert min(times) < 1e-3


def test_windows_are_told_from_frames() -> None:
    assert not is_window(frame(1), SPECS)
    assert is_window({"observation.state": np.zeros((1, 3, 2)), "tokens": np.zeros((1, 4))}, SPECS)


@pytest.fixture
def policy(toy_artifact: Artifact) -> CompiledPolicy:
    return load(toy_artifact.path, seed=0)


def test_select_action_computes_when_the_chunk_is_used_up(policy: CompiledPolicy) -> None:
    """Two actions a chunk: calls 1 and 3 compute, and what they give is ``predict_action``'s chunk."""
    obs = {"obs": torch.tensor([[0.3, -1.2]])}
    chunk = policy.predict_action(obs, noise=some_noise(1), plan="dense")["action"]
    assert chunk.shape == (1, 2, 2)
    policy.reset()
    found, reports = [], []
    for _ in range(3):
        found.append(policy.select_action(obs | {"action": None}, noise=some_noise(1), plan="dense"))
        reports.append(policy.last_report)
    assert reports[0] is reports[1] is not reports[2]
    assert isinstance(found[0], torch.Tensor)
    assert torch.equal(torch.stack(found[:2], dim=1), chunk) and torch.equal(found[2], chunk[:, 0])
    whole = policy.predict_action_chunk(obs, noise=some_noise(1), plan="dense")
    assert torch.equal(whole, chunk)
    report = policy.last_report
    assert torch.equal(policy.select_action(obs), chunk[:, 1])  # the queue of actions was left alone
    assert policy.last_report is report


@pytest.mark.parametrize("method", ["select_action", "predict_action_chunk"])
def test_tensors_that_are_no_observations_do_not_make_the_action_one(policy: CompiledPolicy, method: str) -> None:
    batch = {"index": torch.zeros(1), "obs": np.zeros((1, 2), np.float32)}
    assert isinstance(getattr(policy, method)(batch), np.ndarray)


@pytest.mark.parametrize("method", ["select_action", "predict_action_chunk"])
def test_a_call_that_fails_keeps_no_frame(policy: CompiledPolicy, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Made again with a right plan and noise, it sees the same frames as one that did not fail."""
    monkeypatch.setattr("ttscompile.runtimes.policy.is_window", lambda *_: False)  # the toy's windows are frames
    call = getattr(policy, method)
    for value in (1, 2):
        obs = {"obs": np.full((1, 2), value, np.float32)}
        for wrong, error in (({"plan": "nowhere"}, IllegalPlanError), ({"noise": some_noise(3)}, ObservationError)):
            before = dict(policy._queues._frames)
            with pytest.raises(error):
                call(obs, **wrong)
            assert policy._queues._frames == before and not policy.queued
        call(obs, noise=some_noise(1), plan="dense")
        assert policy._queues._frames["obs"][-1].tolist() == [[value, value]]
        while policy.queued:
            policy._queues.pop()


def test_reset_drops_actions_and_streams(policy: CompiledPolicy) -> None:
    policy.select_action({"obs": np.zeros((1, 2), np.float32)}, noise=some_noise(1), plan="dense")
    first = policy.last_report
    with pytest.raises(ObservationError, match=r"only after reset\(\)"):
        policy.select_action({"obs": np.zeros((2, 2), np.float32)})
    policy.reset()
    action = policy.select_action({"obs": np.zeros((2, 2), np.float32)}, noise=some_noise(2), plan="dense")
    assert action.shape == (2, 2) and policy.last_report is not first


def test_an_overflow_ends_the_episode_of_the_queues_too(
    policy: CompiledPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says that the episode has ended, as by ``reset``: then another number of streams may come."""
    one, two = ({"obs": np.zeros((n, 2), np.float32)} for n in (1, 2))
    for _ in range(2):  # a chunk
        policy.select_action(one, noise=some_noise(1), plan="dense")
    predict = policy._runtime.predict

    def overflown(*given: Any, **named: Any) -> Any:
        sample, report = predict(*given, **named)
        return sample + np.float32(np.inf), report

    with monkeypatch.context() as patched:
        patched.setattr(policy._runtime, "predict", overflown)
        with pytest.raises(NonFiniteActionsError, match=r"ended, as by reset\(\)"):
            policy.select_action(one, noise=some_noise(1), plan="dense")
    assert policy.select_action(two, noise=some_noise(2), plan="dense").shape == (2, 2)
