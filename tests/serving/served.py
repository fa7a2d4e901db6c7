"""Send many small messages to a server: what do it and its answers become?

    python -m tests.serving.served --messages 1000000

Prints one JSON document, with the figures after each tenth, which has a connection of its own.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from contextlib import suppress
from statistics import median
from typing import Any

from tests.runtimes.unloaded import left
from ttscompile.runtimes.executor import ExecutorSettings

from .serving import ServerError, connected, serving

SETTINGS = ExecutorSettings(max_hold=1000, trace_events=0, statistics_window=16)
"""What is remembered on purpose is soon full."""


def talk(call: Any, rounds: int) -> list[float]:
    """Seconds until the answer to each message: two that are right and two that are not, a round."""
    took = []
    for _ in range(rounds):
        for method, arguments in (
            ("observe", {"obs": {"obs": [0.0, 0.0]}}),
            ("info", {}),
            ("observe", {}),
            ("nothing", {}),
        ):
            sent = time.perf_counter()
            with suppress(ServerError):
                call(method, **arguments)
            took.append(time.perf_counter() - sent)
    return took


def served(messages: int) -> list[dict[str, float]]:
    """After each tenth of the messages, what ``left`` says of this process, and the median of that tenth's answers."""
    made: list[dict[str, float]] = []
    with serving(settings=SETTINGS) as url:
        for number in range(1, 11):
            with connected(url) as call:
                middle = median(talk(call, messages // 40))
                gc.collect()
                # While it is connected: when the server lets go of a connection that has ended is its own affair.
                figures = left()
            made.append({"messages": number * 4 * (messages // 40), **figures, "median_ms": round(1000 * middle, 3)})
    return made


def main() -> None:
    """Talk to a server in this process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=1_000_000)
    print(json.dumps(served(parser.parse_args().messages)))


if __name__ == "__main__":
    main()
