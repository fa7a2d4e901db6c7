"""What proposers are given, on small policies."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
