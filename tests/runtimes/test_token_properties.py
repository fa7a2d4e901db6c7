"""Tokens that are reused, frame after frame of anything that a camera may show, against their definition."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.families import cameras
from tests.families.cameras import act, counted, frame, happened, moved, picture
from tests.once import Once
from ttscompile import Plan, TokenReuse
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.plan import DENSE
from ttscompile.runtimes.frames import FramePieces
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend
from ttscompile.runtimes.onnxruntime.sessions import Sessions
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.tokens import TokenWork

from .all_fields import Literally

pytestmark = pytest.mark.slow

TOKENS, THRESHOLDS, REFRESHES = 37, (0.0, 0.0437, 0.311), (1, 3, 32)
EVENTS = ("still", "patch", "some", "light", "noise", "shifted", "cut", "frozen", "swapped", "back", "reset")


@pytest.fixture(scope="module")
def artifact(once: Once) -> Artifact:
    return load_artifact(cameras.compiled_tokens(once) / "artifact")


@pytest.fixture(scope="module")
def literally(artifact: Artifact) -> Iterator[Literally]:
    with pytest.MonkeyPatch.context() as patch:
        yield Literally(patch, artifact, "frame_00")


@pytest.fixture(scope="module")
def all_frames(artifact: Artifact, literally: Literally) -> dict[tuple[float, int], FramePieces]:
    """By threshold and refresh."""
    found, sessions = dict[tuple[float, int], FramePieces](), Sessions(1)
    for threshold in THRESHOLDS:
        for refresh in REFRESHES:
            plan = Plan(cells=artifact.plans[DENSE].cells, tokens=TokenReuse(threshold, refresh))
            with artifact.reading():
                found[threshold, refresh] = OnnxBackend(view_of(artifact, plan), sessions, {}).frames
    return found


Story = st.lists(st.tuples(st.sampled_from(EVENTS), st.integers(0, 35), st.floats(0.0, 0.5, width=16)), max_size=8)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.sampled_from(THRESHOLDS), st.sampled_from(REFRESHES), st.integers(1, 2), Story)
def test_frames_have_what_the_definition_says(
    all_frames: dict[tuple[float, int], FramePieces],
    literally: Literally,
    threshold: float,
    refresh: int,
    streams: int,
    story: list[tuple[str, int, float]],
) -> None:
    """Which tokens are computed and why, which have rows of a similar one, and what comes out, to rounding.

    A frozen camera shows what it showed, however often; ``back`` is the picture that was there before the last one.
    """
    frames = all_frames[threshold, refresh]
    frames.forget()
    shown = [[picture(2 * s), picture(2 * s + 1)] for s in range(streams)]
    before, frozen = [list(pair) for pair in shown], False
    for what, where, much in (("still", 0, 0.0), *story):
        if what == "reset":
            frames.forget()
        frozen = what == "frozen" or (frozen and what != "cut")
        last = [list(pair) for pair in shown]
        if what == "back":
            shown = before
        elif not frozen:
            shown[where % streams] = happened(what, shown[where % streams], where, much)
        before = last
        seen = frame(*((pair[0], pair[1]) for pair in shown))
        obs = {key: np.stack([value, value], 1) for key, value in seen.items()}
        done = len(literally.works)
        values = frames.values(obs)
        (rows,) = (frames._rows_of(obs)[name] for name in frames._pieces["frame_00"].inputs)
        expected = literally.given(frames, obs, rows)
        for found, wanted in zip(values.values(), expected, strict=True):
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5)
        assert frames.work.by_camera == tuple(literally.works[done:])
        own = [(work.camera, work.stream) for work in frames.work.by_camera]
        assert len(set(own)) == len(own) == frames.work.computed, "a frame is computed once"


@pytest.fixture
def policy(artifact: Artifact) -> CompiledPolicy:
    return open_policy(artifact, seed=0, plan=Plan(cells=artifact.plans[DENSE].cells, tokens=TokenReuse(0.0, 4)))


def works(policy: CompiledPolicy) -> dict[str, list[TokenWork]]:
    """Of the last call, by camera."""
    assert policy.last_report is not None
    found: dict[str, list[TokenWork]] = {camera: [] for camera in cameras.CAMERAS}
    for work in policy.last_report.frames.by_camera:
        found[work.camera].append(work)
    return found


def test_a_camera_that_freezes_and_goes_on(policy: CompiledPolicy, artifact: Artifact) -> None:
    """What it shows is known while it stands, and is no new frame: no refresh comes nearer."""
    left, right = picture(0), picture(1)
    act(policy, frame((left, right)), frame((left, right)))
    first = {"of": TOKENS, "first": TOKENS, "stream": 0}
    assert works(policy) == {camera: [TokenWork(camera=camera, **first)] for camera in cameras.CAMERAS}
    for step in range(6):
        before, right = right, moved(right, step)
        act(policy, frame((left, before)), frame((left, right)))
        changed = {"refresh": TOKENS} if step == 3 else {"changed": 1, "filled": 4}
        assert works(policy) == {"left": [], "right": [TokenWork(TOKENS, **changed, camera="right")]}
    goes_on = moved(left, 20)
    found = act(policy, frame((left, right)), frame((goes_on, right)))
    assert works(policy) == {"left": [TokenWork(TOKENS, changed=1, filled=4, camera="left")], "right": []}
    exact = open_policy(artifact, seed=0, plan=DENSE)
    near = act(exact, frame((left, right)), frame((goes_on, right)))
    assert 0 < np.abs(found - near).max() < 0.1


def test_a_camera_that_swaps_with_another_reads_nothing_of_it(policy: CompiledPolicy, artifact: Artifact) -> None:
    """Both are computed whole, since all patches changed; what each saw before is known when they swap back."""
    exact = open_policy(artifact, seed=0, plan=DENSE)
    plain, swapped = frame((picture(0), picture(1))), frame((picture(1), picture(0)))
    act(policy, plain, plain)
    found = act(policy, plain, swapped)
    assert counted(policy) == (2 * TOKENS, 2 * TOKENS)
    assert all(work.changed == 36 for own in works(policy).values() for work in own)
    np.testing.assert_allclose(found, act(exact, plain, swapped), rtol=0, atol=1e-5)
    found = act(policy, swapped, plain)
    assert counted(policy) == (0, 0)
    np.testing.assert_allclose(found, act(exact, swapped, plain), rtol=0, atol=1e-5)


def test_why_tokens_are_computed_is_told_of_each_stream(artifact: Artifact) -> None:
    """Of a batch whose second stream alone changes, by more than three quarters."""
    policy = open_policy(artifact, seed=0, plan=Plan(cells=artifact.plans[DENSE].cells, tokens=TokenReuse(0.01, 9)))
    pairs: Any = ((picture(0), picture(1)), (picture(2), picture(3)))
    act(policy, frame(*pairs), frame(*pairs))
    assert {(w.camera, w.stream, w.first) for own in works(policy).values() for w in own} == {
        (camera, stream, TOKENS) for camera in cameras.CAMERAS for stream in (0, 1)
    }
    changed = pairs[1][0]
    for patch in range(30):
        changed = moved(changed, patch)
    act(policy, frame(*pairs), frame(pairs[0], (changed, pairs[1][1])))
    assert works(policy) == {"left": [TokenWork(TOKENS, changed=30, filled=7, camera="left", stream=1)], "right": []}
