"""Frames in, windows out."""

import sys
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ttscompile import ObservationSpec
from ttscompile.errors import ObservationError
from ttscompile.runtimes.executor.window import MOST_FRAMES, FrameSpec, ObservationWindow

SPECS = {
    "obs": ObservationSpec((2, 3)),
    "image": ObservationSpec((2, 4, 4), dtype="uint8"),
    "goal": ObservationSpec((5,)),
}


def frame(value: float) -> dict[str, np.ndarray]:
    return {"obs": np.array([value])}


def window(steps: int = 2, tolerance: float = 0.3, times: list[float] | None = None) -> ObservationWindow:
    made = ObservationWindow(steps, 0.1, tolerance, 0.3)
    for time in times or []:
        made.add(time, frame(time), time)
    return made


def values(made: ObservationWindow) -> list[float] | None:
    return None if made.complete is None else [float(each["obs"][0]) for each in made.complete.frames]


def times_of(made: ObservationWindow) -> list[float]:
    """Times of the frames that are kept."""
    return [time for time, _ in made._frames]


def test_the_first_axis_of_a_history_is_time() -> None:
    spec = FrameSpec.of(SPECS, 2)
    assert spec.history == {"obs", "image"}
    assert {key: one.shape for key, one in spec.specs.items()} == {"obs": (3,), "image": (4, 4), "goal": (5,)}
    assert spec.steps == 2
    alone = FrameSpec.of({"goal": SPECS["goal"]}, 2)
    assert (alone.steps, alone.history) == (1, frozenset())


def test_an_observation_is_stacked_and_has_a_batch_of_one() -> None:
    spec = FrameSpec.of(SPECS, 2)
    frames: list[dict[str, Any]] = [
        {"obs": np.full(3, v, np.float32), "image": np.full((4, 4), v, np.uint8), "goal": np.full(5, v, np.float32)}
        for v in (1, 2)
    ]
    made = spec.observation(frames)
    assert {key: array.shape for key, array in made.items()} == {
        "obs": (1, 2, 3),
        "image": (1, 2, 4, 4),
        "goal": (1, 5),
    }
    assert made["obs"][0, :, 0].tolist() == [1, 2]
    assert made["goal"][0, 0] == 2


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (
            {"obs": np.zeros(4, np.float32)},
            r"one frame of observation 'obs' must be float32 \[3\]; found float32 \[4\]",
        ),
        (
            {"obs": np.zeros((2, 3), np.float32)},
            r"Give one frame of one robot, \[0\] say; the executor makes the window",
        ),
        ({"obs": np.zeros((1, 3), np.float32)}, r"Give one frame of one robot, \[0\] say; .* of 2"),
        ({"obs": np.zeros(3)}, r"found float64 \[3\]. Convert it with .astype"),
        ({"obs": np.array([0, np.nan, 0], np.float32)}, r"'obs' must be finite; found nan at index \(1,\)"),
        ({"obs": [0.0, 0.0, 0.0]}, "is a list; expected a numpy array"),
        ({}, r"expected the observation keys \['obs'\]; found \[\]"),
        ({"obs": np.zeros(3, np.float32), "more": 1}, r"found \['more', 'obs'\]"),
        (np.zeros(3), "is a ndarray; expected a dictionary"),
    ],
)
def test_a_wrong_frame_is_refused(obs: object, message: str) -> None:
    spec = FrameSpec.of({"obs": SPECS["obs"]}, 2)
    with pytest.raises(ObservationError, match=message):
        spec.check(obs)  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", [(3, 8, 9), (8, 9, 3)])
def test_a_picture_of_bytes_is_refused_with_advice(shape: tuple[int, ...]) -> None:
    spec = FrameSpec.of({"front": ObservationSpec((2, 3, 8, 9), bounds=(0.0, 1.0))}, 2)
    with pytest.raises(ObservationError, match=r"must be float32 \[3, 8, 9\]; found uint8") as refused:
        spec.check({"front": np.zeros(shape, np.uint8)})
    assert "Divide by 255, channels first: image.astype(np.float32) / 255." in str(refused.value)
    assert ("np.moveaxis(image, -1, -3)" in str(refused.value)) == (shape[-1] == 3)


def test_a_window_needs_all_its_frames_and_repeats_none() -> None:
    made = window(3, times=[0.0, 0.1])
    assert made.complete is None
    assert made.why_incomplete() == "2 of 3 frames came"
    made.add(0.2, frame(0.2), 0.2)
    assert values(made) == [0.0, 0.1, 0.2]


@pytest.mark.parametrize(
    ("times", "before", "time", "what", "after"),
    [
        pytest.param([0.0, 0.1, 0.3], [0.0, 0.1], 0.4, "added", [0.3, 7.0], id="a gap"),
        pytest.param([0.0, 0.2], None, 0.1, "added", [7.0, 0.2], id="out of order"),
        pytest.param([1.0, 1.1], [1.0, 1.1], 0.5, "late", [1.0, 1.1], id="too old for any window"),
        pytest.param([0.0, 0.1], [0.0, 0.1], 0.1, "replaced", [0.0, 7.0], id="a second one of a time"),
    ],
)
def test_a_frame_more(
    times: list[float], before: list[float] | None, time: float, what: str, after: list[float]
) -> None:
    made = window(times=times)
    assert values(made) == before
    assert made.add(time, frame(7), max(*times, time)) == what
    assert values(made) == after


def test_faster_frames_are_sampled_at_the_policys_rate() -> None:
    made = window(3, times=[i / 50 for i in range(30)])
    assert values(made) == pytest.approx([0.38, 0.48, 0.58])


def test_slower_frames_make_no_window_and_the_reason_is_told() -> None:
    made = window(times=[0.0, 0.2, 0.4])
    assert made.complete is None
    assert "every 0.1 s, to within 0.03 s; the newest came 0.2 s apart" in made.why_incomplete()
    assert made.trouble == made.why_incomplete()


@pytest.mark.parametrize("period", [0.0665, 0.14, 0.5, 3.0])
def test_frames_at_another_rate_are_a_trouble_that_is_told(period: float) -> None:
    made = window(2)
    assert made.trouble == ""
    for number in range(5):
        made.add(number * period, frame(number), number * period)
        assert (made.trouble == "") is (number * period < 0.13)
    apart = f"{period:.4g}" if period < 0.43 else "more than 0.43"
    assert f"the newest came {apart} s apart. Set policy_hz" in made.trouble


def test_frames_that_make_a_window_are_no_trouble() -> None:
    made = window(2)
    for number in range(20):
        made.add(number * 0.01, frame(number), number * 0.01)
        assert made.trouble == ""
    made.add(3.0, frame(3.0), 3.0)
    assert made.trouble == ""


@pytest.mark.parametrize(("time", "complete"), [(0.1299, True), (0.1301, False), (0.0701, True), (0.0699, False)])
def test_the_tolerance(time: float, complete: bool) -> None:
    assert (window(times=[0.0, time]).complete is not None) is complete


def test_old_frames_are_thrown_away() -> None:
    made = window(times=[i * 0.01 for i in range(90)])
    assert len(made._frames) == 44  # of 0.3 s, a period and the tolerance
    made.add(10.0, frame(10), 10.0)
    assert times_of(made) == [10.0]
    assert window(times=[]).complete is None  # of the next episode, which has a window of its own


@pytest.mark.parametrize("hz", [1000, 3000, 10_000, 40_000])
@pytest.mark.parametrize("jitter", [0.0, 3.0])
def test_frames_at_any_rate_make_windows_in_a_bounded_memory(hz: int, jitter: float) -> None:
    """Jitter is of the times on their way, in frames: they come out of order, as from several threads."""
    made, chance = window(3), np.random.default_rng(0)
    times: list[float] = [(i + chance.uniform(0, jitter)) / hz for i in range(2 * hz // 5)]
    for time in times:
        made.add(time, frame(time), time)
        assert len(made._frames) <= MOST_FRAMES
    assert values(made) == pytest.approx([max(times) - 0.2, max(times) - 0.1, max(times)], abs=0.001)
    assert times_of(made) == sorted(times_of(made))


@pytest.mark.parametrize("added", [0.3, 0.2, 0.25, 5.0, -9.0])
@pytest.mark.parametrize("line", range(15))
def test_a_handler_that_raises_between_two_changes_leaves_a_window_that_goes_on(added: float, line: int) -> None:
    """As of a signal, at any line of ``add``, whatever it does there: add, replace, leave out, throw away."""
    made, left = window(times=[0.0, 0.1, 0.2]), iter(range(line))

    def interrupt(code: Any, event: str, _: object) -> Any:
        if code.f_code.co_name == "add" and event == "line" and next(left, None) is None:
            raise KeyboardInterrupt
        return interrupt

    tracing = sys.gettrace()
    sys.settrace(interrupt)
    try:
        with suppress(KeyboardInterrupt):
            made.add(added, frame(added), max(added, 0.2))
    finally:
        sys.settrace(tracing)
    assert times_of(made) == sorted({*times_of(made)})
    for time in (5.1, 5.2):
        assert made.add(time, frame(time), time) == "added"
    assert values(made) == [5.1, 5.2]


def test_the_next_frame_is_expected_when_the_last_ones_say() -> None:
    assert window(times=[0.0]).interval == pytest.approx(0.1)
    assert window(times=[0.0, 0.02]).interval == pytest.approx(0.02)
    assert window(times=[0.0, 0.15]).interval == pytest.approx(0.1)


@given(st.lists(st.integers(0, 40), min_size=1, max_size=40), st.integers(1, 4))
def test_a_window_is_always_the_newest_there_is(times: list[int], steps: int) -> None:
    """Against a search over everything that is kept."""
    made = ObservationWindow(steps, 2.0, 0.3, 4.0)  # so that a frame must stand exactly in its place
    now = max(times)
    for time in times:
        made.add(float(time), frame(time), float(now))
    kept = set(times_of(made))
    assert kept == {float(t) for t in times if t >= now - (4.0 + 2.0 * (steps - 1) + 0.6)}
    whole = [t for t in kept if all(t - 2.0 * back in kept for back in range(steps))]
    expected = None if not whole else [max(whole) - 2.0 * back for back in reversed(range(steps))]
    assert values(made) == expected
