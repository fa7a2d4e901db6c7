"""What proposers are given, on small policies."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.families import cameras
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.arguments import CallLimits
from ttscompile.calibration.budget import SPARSITY, Goal
from ttscompile.calibration.calls import load_episodes
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.proposer import Proposal, Proposer, Request
from ttscompile.calibration.state import StateFile
from ttscompile.calibration.trials import Trials
from ttscompile.core.plan import Plan


def request(**fields: Any) -> Request:
    """What was asked for: of the fields that proposers read, these. A bound that is given holds for all plans."""
    if "bound" in fields:
        fields = {"farthest": fields["bound"], **fields}
    return Request(Goal(SPARSITY, 0.8), **fields)


def trials_of(directory: Path, recordings: Sequence[Path], calls: int = 64) -> Trials:
    """Of an artifact, with so many calls to learn from."""
    artifact = load_artifact(directory)
    episodes = load_episodes(artifact.manifest.spec, list(recordings), None)
    return Trials.of(artifact, episodes, StateFile(directory, {}), limits=CallLimits(*(calls,) * 3))


def proposed(proposer: Proposer, trials: Trials, plan: Plan) -> list[Proposal]:
    """All that is proposed, whatever the time."""
    return list(proposer.propose(trials, plan, Clock()))


def recorded(path: Path, shaking: float = 0.0) -> list[Path]:
    """Four episodes of six calls: a spot wanders over a fixed picture."""
    rng, calls = np.random.default_rng(0), 24
    still = 0.1 + 0.5 * rng.random((2, 3, cameras.SIDE, cameras.SIDE), dtype=np.float32)
    frames = np.tile(still, (calls + 1, 1, 1, 1, 1))  # [N, camera, ...]
    for i, frame in enumerate(frames):
        frame[:, :, 4 * (i % 6) : 4 * (i % 6) + 4, 8:12] += 0.3
    frames = np.clip(frames + np.asarray(shaking * rng.standard_normal(frames.shape), np.float32), 0, 1)
    windows = np.stack([frames[:-1], frames[1:]], 1)
    views: dict[str, npt.NDArray[np.float32]] = {key: windows[:, :, i] for i, key in enumerate(cameras.CAMERAS)}
    state = rng.random((calls, 2, 4), dtype=np.float32)
    np.savez(path, state=state, episode_ends=np.array([6, 12, 18, 24]), **views)  # type: ignore[arg-type]
    return [path]
