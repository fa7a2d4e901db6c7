"""The example of a whole vision-language-action policy, on the tiny one that lerobot saved."""

import sys
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.trajectories import load_trajectories

from .recipes import script


@pytest.mark.slow
def test_it_drives_and_records(
    once: Once, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    directory, model = (shared / "golden" / "lerobot_whole" / name for name in ("smolvla", "smolvlm-tiny"))
    compiled, _ = once.compiled("smolvla", lambda to: ttscompile.convert(directory, to))
    arguments = ["drive.py", str(compiled), f"--tokenizer={model}", "--ticks=60", f"--record={tmp_path / 'calls.npz'}"]
    monkeypatch.setattr(sys, "argv", arguments)
    script(Path(__file__).parents[2] / "examples" / "vla", "drive").main()
    assert "'pick up the cup': 60 ticks, 2 calls of" in capsys.readouterr().out
    episodes = load_trajectories([tmp_path / "calls.npz"], load_artifact(compiled).manifest.spec.observations, 50)
    assert [episode.calls for episode in episodes] == [2, 2]
    first, second = (episode.observations["observation.language.tokens"] for episode in episodes)
    assert not np.array_equal(first, second)
