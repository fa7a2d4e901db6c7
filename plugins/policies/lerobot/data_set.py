"""The data set that a policy was trained on, as LeRobot's training notes it."""

import os
import re
from pathlib import Path

from ttscompile.frontends.settings import read_json
from ttscompile.hub.repository import DATA_SETS

NOTE = "train_config.json"
_NAME = re.compile(r"\w[\w.-]*/\w[\w.-]*")


def recordings(directory: Path) -> str | None:
    """Where its episodes are; see ``Family``.

    The folder that the training read, or the one of that name among LeRobot's own, if there is one on this machine;
    else its name on the hub.
    """
    data = read_json(directory / NOTE).get("dataset") if (directory / NOTE).is_file() else None
    name, root = (data.get("repo_id"), data.get("root")) if isinstance(data, dict) else (None, None)
    folders = [Path(root)] if isinstance(root, str) else []
    if isinstance(name, str) and _NAME.fullmatch(name):
        folders.append(_home() / name)
    here = (str(folder) for folder in folders if (folder / "meta" / "info.json").is_file())
    return next(here, f"{DATA_SETS}{name}" if isinstance(name, str) else None)


def _home() -> Path:
    """Where LeRobot keeps what it records and downloads."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    hub = os.environ.get("HF_HOME", f"{cache}/huggingface")
    return Path(os.environ.get("HF_LEROBOT_HOME", f"{hub}/lerobot")).expanduser()
