"""The script that times calls in which nothing can be reused."""

from __future__ import annotations

from pathlib import Path

import in_vain
import numpy as np
import pytest
from click.testing import CliRunner

from tests.families import cameras
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.errors import TtscompileError
from ttscompile.runtimes.load import open_policy


def test_who_looks_for_nothing_known_computes_the_same(once: Once) -> None:
    artifact, rng = load_artifact(cameras.compiled_tokens(once) / "artifact"), np.random.default_rng(0)
    policy, plain = (open_policy(artifact, seed=0) for _ in range(2))
    in_vain.forget(plain)
    obs = {key: one.draw(rng) for key, one in artifact.manifest.spec.observations.items()}
    for _ in range(2):
        for one in (policy, plain):
            one.reset(seed=0)
        first, second = ([one.predict_action(obs)["action"] for _ in range(2)] for one in (policy, plain))
        np.testing.assert_array_equal(first, second)
    known, none = (one.last_report for one in (policy, plain))
    assert known is not None and none is not None
    assert known.frames.remembered == 2 * 2 and none.frames.remembered == 0  # frames of each camera


def test_every_way_is_timed_on_the_same_calls(once: Once) -> None:
    told = CliRunner().invoke(in_vain.main, [str(cameras.compiled_tokens(once) / "artifact"), "--calls", "4"])
    assert told.exit_code == 0, told.output
    lines = told.output.splitlines()
    assert [line.rpartition(": ")[2] for line in lines] == [in_vain.PLAIN, in_vain.KNOWN, in_vain.TOKENS]
    assert "1.000 [1.000, 1.000]" in lines[0]


def test_a_policy_without_tokens_is_refused(compiled_layer: Path) -> None:
    with pytest.raises(TtscompileError, match="none of its image encoders has tokens"):
        in_vain.measured(compiled_layer, 2, 2)
