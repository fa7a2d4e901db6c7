"""Ways to find a plan: one file each, behind the interface in ``base``."""

from __future__ import annotations

from ...errors import CalibrationError
from .base import Found, Strategy, Task
from .interval import Interval
from .tts import Tts

NAMES = ("tts", "interval")

__all__ = ["NAMES", "Found", "Strategy", "Task", "open_strategy", "require_strategy"]


def require_strategy(name: str) -> None:
    """Refuse a name that no strategy has.

    Raises:
        CalibrationError: lists those that there are.
    """
    if name not in NAMES:
        raise CalibrationError(f"no strategy is called {name!r}; expected one of {', '.join(NAMES)}.")


def open_strategy(name: str, task: Task) -> Strategy:
    """The strategy of this name, ready to begin.

    Raises:
        CalibrationError: there is none.
    """
    require_strategy(name)
    return Tts(task) if name == "tts" else Interval(task)
