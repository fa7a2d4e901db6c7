"""Episodes on several cores or machines: each process runs some of the seeds, and this one keeps them in the cache."""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from environments import environment_class
from episodes import Episodes
from rollout import Episode, run_episodes
from variants import Variant, open_variant

from ttscompile.pool import Pool, Work

Part = tuple[str, list[int]]
"""A variant, as ``open_variant`` takes it, and seeds."""

_opened = lru_cache(open_variant)  # one for each process


class Processes:
    """A pool of processes of this machine; see ``ttscompile.pool``.

    Args:
        count: of them.
    """

    def __init__(self, count: int) -> None:
        self.count = count

    def map(self, work: Work, parts: Sequence[Part]) -> Iterator[list[Episode]]:
        """What comes of each part, in order."""
        # A fork of a process that has threads of onnxruntime would wait for them for ever. Of what is warned about the
        # same artifacts here, they say nothing again.
        again: Any = {"initializer": warnings.simplefilter, "initargs": ("ignore", UserWarning)}
        with ProcessPoolExecutor(self.count, multiprocessing.get_context("spawn"), **again) as pool:
            yield from pool.map(work.here, parts)


def fill_cache(
    environment: str,
    texts: Sequence[str],
    seeds: Sequence[int],
    batch: int,
    runtime: str,
    root: Path,
    pool: Pool,
    on_done: Callable[[str, int], None],
) -> None:
    """Run the episodes of all variants that are not in the cache yet.

    Args:
        environment: its name.
        texts: variants, as ``open_variant`` takes them.
        seeds: of the episodes.
        batch: episodes in lockstep, at most; fewer where that keeps all processes busy.
        runtime: of ``ttscompile.load``; each process has one thread of arithmetic.
        root: of the cache.
        pool: of ``Processes``, or of the machines of a cluster, which see artifacts under the same paths.
        on_done: told the label of a variant and its number of episodes in the cache.
    """
    parts: list[Part] = []
    done, caches = {}, {}
    for text in texts:
        cache = caches[text] = Episodes(root, environment, open_variant(text, runtime, 1), runtime)
        missing = [seed for seed in seeds if cache.read(seed) is None]
        done[text] = len(seeds) - len(missing)
        on_done(text, done[text])
        size = max(1, min(batch, -(-len(missing) // pool.count)))
        parts += [(text, missing[i : i + size]) for i in range(0, len(missing), size)]
    if not parts:
        return
    work = Work(_elsewhere(environment, runtime), _elsewhere, (environment, runtime))
    for (text, some), episodes in zip(parts, pool.map(work, parts), strict=True):
        for episode in episodes:
            caches[text].write(episode)
        done[text] += len(some)
        on_done(text, done[text])


def _elsewhere(environment: str, runtime: str) -> Callable[[Part], list[Episode]]:
    return partial(_run, environment, runtime)


def _run(environment: str, runtime: str, part: Part) -> list[Episode]:
    """One batch of episodes of one variant."""
    text, seeds = part
    variant: Variant = _opened(text, runtime, 1)
    return list(run_episodes(environment_class(environment), variant, seeds, len(seeds)).episodes)
