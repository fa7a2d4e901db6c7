"""Load and let go, many times in one process: what is left of memory, descriptors and threads?

    python tests/runtimes/unloaded.py --loads 5000

Prints one JSON document, with the figures after each tenth.
"""

import argparse
import gc
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path


def left() -> dict[str, float]:
    """Resident memory of this process in MB of 2**20 bytes, and the number of its descriptors and threads."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    descriptors = len(list(Path("/proc/self/fd").iterdir()))
    return {
        "rss_mb": round(int(lines["VmRSS"].split()[0]) / 1024, 1),
        "descriptors": descriptors,
        "threads": int(lines["Threads"]),
    }


def load_and_let_go(path: Path, loads: int, seconds: float = float("inf")) -> list[dict[str, float]]:
    """What is left after each tenth of the loads, or of those that there was time for."""
    import ttscompile

    ends, made = time.monotonic() + seconds, []
    for number in range(1, loads + 1):
        ttscompile.load(path)
        if number % max(1, loads // 10) == 0:
            gc.collect()
            made.append({"loads": number, **left()})
        if time.monotonic() > ends:
            break
    return made


def main() -> None:
    """Load a toy, from a directory or zipped."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loads", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop then, however many were made")
    parser.add_argument("--zipped", action="store_true")
    options = parser.parse_args()
    from tests.runtimes.toys import toy_program, written_artifact

    with tempfile.TemporaryDirectory() as name:
        path = written_artifact(toy_program(2, 2), Path(name, "toy")).path
        if options.zipped:
            path = Path(shutil.make_archive(str(path), "zip", path))
        print(json.dumps(load_and_let_go(path, options.loads, options.seconds)))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    main()
