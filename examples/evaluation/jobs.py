"""Episodes on several cores: each process runs some of the seeds and keeps the episodes in the cache."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import lru_cache
from pathlib import Path

from environments import environment_class
from episodes import Episodes
from rollout import run_episodes
from variants import Variant, open_variant

_opened = lru_cache(open_variant)  # one for each process


def fill_cache(
    environment: str,
    texts: Sequence[str],
    seeds: Sequence[int],
    batch: int,
    runtime: str,
    root: Path,
    jobs: int,
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
        jobs: processes.
        on_done: told the label of a variant and its number of episodes in the cache.
    """
    parts: list[tuple[str, list[int]]] = []
    done = {}
    for text in texts:
        cache = Episodes(root, environment, open_variant(text, runtime, 1), runtime)
        missing = [seed for seed in seeds if cache.read(seed) is None]
        done[text] = len(seeds) - len(missing)
        on_done(text, done[text])
        size = max(1, min(batch, -(-len(missing) // jobs)))
        parts += [(text, missing[i : i + size]) for i in range(0, len(missing), size)]
    if not parts:
        return
    # A fork of a process that has threads of onnxruntime would wait for them for ever.
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        running = {pool.submit(_run, environment, text, some, runtime, root): (text, len(some)) for text, some in parts}
        for future in as_completed(running):
            future.result()
            text, count = running[future]
            done[text] += count
            on_done(text, done[text])


def _run(environment: str, text: str, seeds: Sequence[int], runtime: str, root: Path) -> None:
    """One batch of episodes of one variant."""
    variant: Variant = _opened(text, runtime, 1)
    cache = Episodes(root, environment, variant, runtime)
    run_episodes(environment_class(environment), variant, seeds, len(seeds), cache=cache)
