"""Many calls in episodes of 40: does memory grow, are calls repeatable, how far are the slow ones from the others?

    taskset -c 2 python tests/runtimes/soak.py compiled/ --calls 10000

Prints one JSON document; the test beside this file runs a short version on a toy.
"""

import argparse
import gc
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from time import perf_counter

import numpy as np

import ttscompile
from ttscompile.runtimes.policy import CompiledPolicy

EPISODE = 40


@dataclass(frozen=True)
class Soak:
    """What many calls did.

    Attributes:
        calls: how many.
        before_load_mb: resident memory before the policy was loaded, MB of 2**20 bytes.
        loaded_mb: after.
        rss_mb: after each tenth of the calls.
        growth_kb_a_call: median slope between any two of these, without the first: what grows call by call. A single
            step, which the allocator of a process makes once in a while, does not count.
        p50_ms: of all calls but those of the first episode.
        p99_ms: likewise.
        first_ms: median of the first calls of the episodes.
        load_first_ms: the first call after load.
        collections: runs of Python's garbage collector during the calls.
        digest: of all actions of the first and of the last episode, which are seeded alike.
        repeatable: whether the two are the same.
    """

    calls: int
    before_load_mb: float
    loaded_mb: float
    rss_mb: tuple[float, ...]
    growth_kb_a_call: float
    p50_ms: float
    p99_ms: float
    first_ms: float
    load_first_ms: float
    collections: int
    digest: str
    repeatable: bool


def median_slope(values: Sequence[float]) -> float:
    """Median of the slopes between any two of these values (Theil 1950, Sen 1968); 0 of fewer than two."""
    slopes = [(b - a) / (j - i) for (i, a), (j, b) in combinations(enumerate(values), 2)]
    return float(np.median(slopes)) if slopes else 0.0


def resident_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def soak(directory: Path, calls: int, threads: int = 1, plan: str | None = None) -> Soak:
    """Call a policy on random observations, every episode with the seed of its number; the last with the first's."""
    before = resident_mb()
    policy = ttscompile.load(directory, threads=threads)
    loaded = resident_mb()
    episodes = max(calls // EPISODE, 2)
    times: list[list[float]] = []
    digests: list[str] = []
    memory = []
    collections = sum(one["collections"] for one in gc.get_stats())
    for number in range(episodes):
        seed = 0 if number == episodes - 1 else number
        times.append([])
        digests.append(episode(policy, seed, plan, times[-1]))
        if (number + 1) % max(episodes // 10, 1) == 0:
            memory.append(resident_mb())
    collections = sum(one["collections"] for one in gc.get_stats()) - collections
    later = np.concatenate(times[1:])
    return Soak(
        calls=episodes * EPISODE,
        before_load_mb=before,
        loaded_mb=loaded,
        rss_mb=tuple(memory),
        growth_kb_a_call=median_slope(memory[1:]) * 1024 / (max(episodes // 10, 1) * EPISODE),
        p50_ms=float(np.percentile(later, 50)),
        p99_ms=float(np.percentile(later, 99)),
        first_ms=float(np.median([one[0] for one in times[1:]])),
        load_first_ms=times[0][0],
        collections=collections,
        digest=digests[0],
        repeatable=digests[0] == digests[-1],
    )


def episode(policy: CompiledPolicy, seed: int, plan: str | None, times: list[float]) -> str:
    """One episode; appends the time of each call in ms, and gives the hash of all actions."""
    rng = np.random.default_rng(seed)
    policy.reset(seed)
    digest = hashlib.sha256()
    for _ in range(EPISODE):
        obs = {}
        for key, spec in policy.info.observation.items():
            drawn = rng.uniform(-1, 1, (1, *spec.shape)).astype(np.float32)
            obs[key] = (drawn if spec.normalizer is None else spec.normalizer.unnormalize(drawn)).astype(spec.dtype)
        started = perf_counter()
        out = policy.predict_action(obs, plan=plan)
        times.append(1000 * (perf_counter() - started))
        digest.update(out["action_pred"].tobytes())
    return digest.hexdigest()


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--calls", type=int, default=10_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--plan")
    args = parser.parse_args()
    print(json.dumps(asdict(soak(args.directory, args.calls, args.threads, args.plan)), indent=2))


if __name__ == "__main__":
    main()
