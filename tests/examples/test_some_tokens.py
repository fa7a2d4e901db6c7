"""A policy is driven with fewer tokens, which have rows of similar ones or keep their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import evaluate
import numpy as np
import pytest
import some_tokens
from click.testing import CliRunner

from tests.families import cameras
from tests.families.cameras import act, counted, frame
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.plan import DENSE, TokenReuse
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.tokens import TokenTower

pytestmark = pytest.mark.slow


def test_each_threshold_is_driven_and_counted(once: Once, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two cameras one shows less than before in six patches, and one more in one: two of the first look alike."""
    folder, made = cameras.compiled_tokens(once) / "artifact", list[Any]()
    still = np.full((3, cameras.SIDE, cameras.SIDE), 0.5, np.float32)
    other = still.copy()
    for patch, by in ((0, 0.4), (3, 0.3), (7, 0.35), (20, 0.5), (14, 0.2), (15, 0.15)):
        y, x = divmod(patch, 6)
        other[:, 4 * y : 4 * y + 4, 4 * x : 4 * x + 4] -= by

    def driven(arguments: list[str], standalone_mode: bool) -> None:
        assert arguments[3:] == ["--episodes", "4", "--no-cache"] and not standalone_mode
        variants = [one.rpartition(":") for one in arguments[:3]]
        assert [name for _, _, name in variants] == [DENSE, "over-0.5", "over-0.9"]
        plans = load_artifact(Path(variants[1][0])).plans
        assert plans["over-0.9"].tokens == TokenReuse(0.9, some_tokens.REFRESH)
        policy = open_policy(load_artifact(Path(variants[1][0])), seed=0, plan=plans["over-0.5"])
        act(policy, frame((still, still)), frame((still, still)))
        made.append(act(policy, frame((still, still)), frame((other, still))))
        assert counted(policy) == (5, 37)

    monkeypatch.setattr(evaluate, "main", driven)
    for kept in (False, True):
        with monkeypatch.context() as patched:
            patched.setattr(some_tokens, "setattr", patched.setattr, raising=False)
            asked = [str(folder), "--thresholds", "0.5,0.9", *(["--kept"] if kept else []), "--episodes", "4"]
            result = CliRunner().invoke(some_tokens.main, asked, catch_exceptions=False)
            assert result.output == "0.5: 13.5% of the 37 tokens of new frames were computed\n"
    assert np.abs(made[0] - made[1]).max() > 1e-4, "rows of similar tokens, and the tokens' own"
    assert TokenTower._similar.__name__ == "_similar"
