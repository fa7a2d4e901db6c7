"""Several cores, by working on several calls at once rather than on parts of one operation.

The operations of a policy are small: divided among threads they spend much of their time waiting for the slowest part,
most of all on a machine that does something else as well. Whole calls wait for nobody; and since they are divided in
the same way however many workers there are, so are the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers:
    """As many threads as torch would use for one operation; see ``workers``."""

    def __init__(self, pool: ThreadPoolExecutor, count: int) -> None:
        self._pool, self.count = pool, count

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Results of ``work`` on each item, in order; without gradients, which belong to a thread."""

        def without_gradients(item: Item) -> Result:
            with torch.no_grad():
                return work(item)

        return list(self._pool.map(without_gradients, items))


@contextmanager
def workers() -> Iterator[Workers]:
    """Threads for whole calls; torch uses one thread for each operation meanwhile."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(count, "ttscompile-calibration") as pool:
            yield Workers(pool, count)
    finally:
        torch.set_num_threads(count)
