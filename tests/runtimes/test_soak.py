"""A short soak on a toy whose plan changes from call to call and reads the rollout cache."""

from __future__ import annotations

from ttscompile.artifact.write import update_calibration

from .conftest import MakeArtifact
from .soak import EPISODE, soak
from .toys import toy_program


def test_calls_are_repeatable_and_leave_nothing_behind(make_artifact: MakeArtifact) -> None:
    artifact = make_artifact(toy_program())
    update_calibration(artifact.path, dict(artifact.pruner), {}, "tts", {"strategy": "tts"})
    result = soak(artifact.path, 60 * EPISODE)
    assert result.repeatable
    assert len(result.rss_mb) == 10
    assert result.growth_kb_a_call < 0.25, result  # one more [K, blocks] array kept a call would be seen
    assert 0 < result.p50_ms <= result.p99_ms
