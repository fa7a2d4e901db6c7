"""Time as the executor sees it: injected, so that tests decide what time it is."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """A clock that never goes back, and the only way in which the executor waits."""

    def now(self) -> float:
        """Seconds since some fixed moment."""

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        """Wait until the condition is notified or ``timeout`` seconds of this clock have passed.

        May return early; callers look again at what they wait for.

        Args:
            condition: held by the caller; released while waiting.
            timeout: seconds; None for no limit.
        """


class MonotonicClock:
    """``time.monotonic``: the same in every process of the machine, so frames can be stamped elsewhere."""

    def now(self) -> float:
        """Seconds since some fixed moment."""
        return time.monotonic()

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        """See ``Clock.wait``."""
        condition.wait(None if timeout is None else min(timeout, threading.TIMEOUT_MAX))
