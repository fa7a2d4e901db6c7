"""Convert a policy and print the most anonymous memory that it took.

    python -m tests.frontends.anonymous POLICY OUT [PRECISION]

Pages of mapped files are not counted: the system takes them back when others need the room.
"""

import sys
import threading
from pathlib import Path

ROLLUP = Path("/proc/self/smaps_rollup")
_INTERVAL = 0.02
"""Seconds between two looks; a copy of all weights lives for seconds."""


def anonymous() -> int:
    """Bytes of this process that no file backs."""
    (line,) = [line for line in ROLLUP.read_text().splitlines() if line.startswith("Anonymous:")]
    return int(line.split()[1]) * 1024


def main() -> None:
    """Print the bytes above those before the conversion."""
    import onnxruntime  # noqa: F401 - what is imported on the way is no part of the conversion
    import torch  # noqa: F401

    import ttscompile.driver

    before, most, over = anonymous(), [0], threading.Event()

    def watch() -> None:
        while not over.wait(_INTERVAL):
            most[0] = max(most[0], anonymous())

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        ttscompile.driver.convert(*sys.argv[1:3], precision=(sys.argv[3:] or ["fp32"])[0])
    finally:
        over.set()
        watcher.join()
    print(most[0] - before)


if __name__ == "__main__":
    main()
