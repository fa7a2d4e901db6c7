"""A page shows which patches of a picture were computed."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from tests.families import cameras
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.plan import DENSE, TokenReuse
from ttscompile.report import Extras, build
from ttscompile.report.usage import SEEN_CALLS, run_episode
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.trajectories import Episode

pytestmark = pytest.mark.slow

CALLS = 8


def episode() -> Episode:
    """A spot wanders over the left camera's picture; the right one shows the same all the time."""
    left, right = cameras.picture(0), cameras.picture(1)
    frames = [cameras.frame((cameras.moved(left, number), right)) for number in range(CALLS + 1)]
    windows = {key: np.stack([frame[key][0] for frame in frames]) for key in frames[0]}
    return Episode("wandering", {key: np.stack([rows[:-1], rows[1:]], 1) for key, rows in windows.items()})


@pytest.fixture
def policy(once: Once) -> CompiledPolicy:
    artifact = load_artifact(cameras.compiled_tokens(once) / "artifact")
    plan = replace(artifact.plans[DENSE], tokens=TokenReuse(threshold=0.0, refresh=1000))
    return open_policy(artifact, seed=0, plan=plan)


def test_a_camera_without_a_new_picture_has_no_computed_patch(policy: CompiledPolicy) -> None:
    course = run_episode(policy, episode())
    assert len(course.seen) == SEEN_CALLS
    # The first window has two pictures of the left camera, of which the newer one differs by a patch.
    counts = [[np.count_nonzero(one.computed) for one in each] for each in course.seen.values()]
    assert counts == [[4, 36], *[[4, 0]] * (SEEN_CALLS - 1)]
    works = [[one.work for one in each] for each in course.seen.values()]
    assert (works[0][1].first, works[0][1].changed) == (37, 0), "the first picture of its camera, and a class token"
    assert all(left.changed > 0 == left.first and left.computed > 4 for left, _ in works[1:]), "and without a patch"
    assert 0 < course.frames.tokens < course.frames.of
    assert course.frames.forward == 0, "nothing else changed"


def test_the_page_shows_it(once: Once, policy: CompiledPolicy) -> None:
    artifact = load_artifact(cameras.compiled_tokens(once) / "artifact")
    page = build(artifact, policy, Extras(episode(), calls=1))
    (section,) = (one for one in page.sections if one.title == "Episode")
    (shown,) = section.pictures
    work = run_episode(policy, episode()).frames
    assert shown.caption.startswith(f"{work.tokens} of {work.of} tokens of new frames and scenes were computed")
    drawn = np.asarray(Image.open(BytesIO(shown.png)).convert("RGB")).astype(int)
    half = len(drawn) // 2
    colourful = np.abs(drawn - drawn.mean(-1, keepdims=True)).max(-1) > 40
    # The right camera, in the lower row, is in colour in the first call alone.
    later = slice(drawn.shape[1] // SEEN_CALLS + 10, None)
    assert colourful[half:, : drawn.shape[1] // SEEN_CALLS].any()
    assert colourful[:half, later].any() and not colourful[half:, later].any()
