"""Convert a policy, or load an artifact and answer a call: print the most anonymous memory that it took, in bytes.

    python examples/benchmark/memory.py POLICY OUT [PRECISION]
    python examples/benchmark/memory.py ARTIFACT

Pages of mapped files are not counted: the system takes them back when others need the room.
"""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROLLUP = Path("/proc/self/smaps_rollup")
_INTERVAL = 0.02
"""Seconds between two looks; a copy of all weights lives for seconds."""


def anonymous() -> int:
    """Bytes of this process that no file backs."""
    (line,) = [line for line in ROLLUP.read_text().splitlines() if line.startswith("Anonymous:")]
    return int(line.split()[1]) * 1024


@contextmanager
def watched() -> Iterator[list[int]]:
    """The most that was taken since the beginning, in a list that is kept up to date; 0 where no system tells."""
    most, over = [0], threading.Event()
    before = anonymous() if ROLLUP.exists() else 0

    def watch() -> None:
        while ROLLUP.exists() and not over.wait(_INTERVAL):
            most[0] = max(most[0], anonymous() - before)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield most
    finally:
        over.set()
        watcher.join()


def convert(policy: str, out: str, precision: str = "fp32") -> int:
    """The bytes above those before the conversion."""
    import onnxruntime  # noqa: F401 - what is imported on the way is no part of the conversion
    import torch  # noqa: F401

    import ttscompile.driver

    with watched() as most:
        ttscompile.driver.convert(policy, out, precision=precision)
    return most[0]


def answer(artifact: str) -> int:
    """The bytes above those before it was loaded, after two calls with its default plan."""
    import onnxruntime  # noqa: F401

    import ttscompile
    from ttscompile.artifact.load import load_artifact
    from ttscompile.runtimes.random_calls import random_calls

    with watched() as most:
        policy = ttscompile.load(artifact)
        for obs, noise in random_calls(load_artifact(artifact).manifest.spec, 2, seed=0):
            policy.predict_action(obs, noise=noise)
    return most[0]


def main() -> None:
    """Print the bytes."""
    print(answer(sys.argv[1]) if len(sys.argv) == 2 else convert(*sys.argv[1:]))


if __name__ == "__main__":
    main()
