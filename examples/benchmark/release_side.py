"""One side of ``beside_release.py``, in a process of its own: it answers what it is asked, a line of JSON each.

It is run by the Python of either version, so it uses nothing of ttscompile but what 0.1.0 had.
"""

import json
import re
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SEED = 7


def memory() -> float:
    """MiB of this process that no file backs."""
    found = re.search(r"RssAnon:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


def main(artifact: str, observations: str) -> None:
    """Load the artifact, say what that took, and answer until there is no line left."""
    began = time.process_time()
    import numpy as np

    import ttscompile

    policy: Any = ttscompile.load(artifact)
    loaded = time.process_time() - began
    print(json.dumps({"seconds": loaded, "mib": memory()}), flush=True)
    recorded = dict(np.load(observations))
    count = len(next(iter(recorded.values())))
    calls = [{key: array[i : i + 1] for key, array in recorded.items()} for i in range(count)]

    def timed(obs: Mapping[str, Any], plan: str) -> float:
        start = time.process_time()
        policy.predict_action(obs, plan=plan)
        return 1000 * (time.process_time() - start)

    for line in sys.stdin:
        asked = json.loads(line)
        policy.reset(seed=SEED)
        if "calls" in asked:
            took = [timed(calls[i % len(calls)], asked["plan"]) for i in range(asked["calls"])]
            print(json.dumps({"ms": float(np.median(took)), "mib": memory()}), flush=True)
        else:
            chunks = [policy.predict_action(obs, plan=asked["plan"])["action_pred"] for obs in calls]
            np.save(asked["into"], np.stack(chunks))
            print(json.dumps({}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
