"""At which rate recordings were made, where they say so."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.untrusted_json import parse_json
from ..errors import TrajectoryError
from .episodes import META, local_path, meta_of, other_format, read_npz
from .frames import one_error
from .lerobot_dataset import MAX_INFO


def recorded_rate(paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> float | None:
    """Rate in Hz of the frames and actions of recordings; None where none says it, or where they say different ones.

    A LeRobot data set has it as ``fps``; an ``.npz`` may have ``{"policy_hz": 10}`` in its ``meta``.

    Raises:
        TrajectoryError: what a recording says is no rate.
        HubError: a data set is on the hub, and cannot be had.
    """
    paths = [paths] if isinstance(paths, str | os.PathLike) else paths
    rates = {rate for path in paths if (rate := rate_of(local_path(path))) is not None}
    if len(rates) > 1:
        told = " and ".join(f"{rate:g}" for rate in sorted(rates))
        remedy = "'build --policy-hz' and ExecutorSettings take it"
        warnings.warn(f"the recordings are of {told} Hz, so the policy's rate is not known: {remedy}.", stacklevel=2)
    return rates.pop() if len(rates) == 1 else None


def rate_of(path: Path) -> float | None:
    """The same of one recording, which is on this machine."""
    said, name, kind = dict[str, Any](), "policy_hz", other_format(path)
    if kind == "lerobot":
        name = "fps"
        with one_error(f"{path}: meta/info.json cannot be read"):
            said = dict(parse_json((path / "meta" / "info.json").read_bytes(), MAX_INFO))
    elif kind is None:
        said = meta_of(path, read_npz(path, META).get(META))
    rate = said.get(name)
    if rate is not None and (type(rate) not in (int, float) or not 0 < rate < 1e6):
        raise TrajectoryError(f"{path}: {name} is {rate!r:.80}; expected frames and actions a second.")
    return None if rate is None else float(rate)
