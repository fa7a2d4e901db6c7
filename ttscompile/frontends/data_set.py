"""The data set that a policy of LeRobot was trained on, as its training noted it."""

import os
from pathlib import Path

from ..core.paths import on_hub
from ..errors import CheckpointError
from ..hub import fetch_checkpoint
from ..hub.repository import DATA_SETS
from .settings import read_json

NOTE = "train_config.json"


def recordings_of(checkpoint: str | os.PathLike[str]) -> str:
    """The name of the data set on the hub.

    Raises:
        CheckpointError: the checkpoint names none.
        HubError: it is on the hub, and cannot be had.
    """
    path = fetch_checkpoint(str(checkpoint)).path if on_hub(checkpoint) else Path(checkpoint)
    data = read_json(path / NOTE).get("dataset") if (path / NOTE).is_file() else None
    name = data.get("repo_id") if isinstance(data, dict) else None
    if not isinstance(name, str):
        told = "does not say which data set it was trained on. Give recorded episodes of its robot, with --trajectories"
        raise CheckpointError(f"{os.fspath(checkpoint)}: {told}.")
    return f"{DATA_SETS}{name}"
