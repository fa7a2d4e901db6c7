"""The tokens of one camera are reused, and all of the others' frames are computed."""

from __future__ import annotations

from dataclasses import replace

import pytest
from one_camera import OneCamera

from tests.families import cameras
from tests.families.cameras import act, counted, frame, moved, picture
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.plan import DENSE, TokenReuse
from ttscompile.runtimes.load import open_policy

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("camera", [0, 1])
def test_frames_of_the_other_camera_are_computed_whole(
    once: Once, camera: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    artifact = load_artifact(cameras.compiled_tokens(once) / "artifact")
    policy = open_policy(artifact, seed=0, plan=replace(artifact.plans[DENSE], tokens=TokenReuse(0.0, 1000)))
    one = OneCamera(cameras.CAMERAS[camera])
    one.patch(monkeypatch.setattr)
    first = frame((picture(0), picture(1)))
    act(policy, first, first)
    assert one.computed.tolist() == [0, 0], "the first frame of an episode does not count"
    act(policy, first, frame((moved(picture(0), 3), moved(picture(1), 7))))
    assert counted(policy) == (5 + 37, 74)
    assert one.computed.tolist() == [5, 37]
