"""The versions of LeRobot that this plugin was tried with."""

from __future__ import annotations

import logging
from importlib.metadata import version

TRIED, SERIES = "0.6.1", "0.6."

logger = logging.getLogger(__name__)


def require_lerobot(found: str | None = None) -> None:
    """Raise unless this LeRobot is of the series that was tried; warn of one that was not itself.

    Args:
        found: its version; None for the installed one.

    Raises:
        ImportError: it is of another series.
    """
    found = version("lerobot") if found is None else found
    if not found.startswith(SERIES):
        raise ImportError(
            f"lerobot_policy_ttscompile {version('lerobot_policy_ttscompile')} was tried with lerobot {TRIED}, and"
            f" found {found}: install 'lerobot>={TRIED},<0.7', or a later version of the plugin"
        )
    if found != TRIED:
        logger.warning("this plugin was tried with lerobot %s, and this is %s", TRIED, found)
