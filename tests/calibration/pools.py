"""Pools of other processes, real and made up."""

import importlib.util
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from ttscompile.errors import ClusterError
from ttscompile.pool import Work

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="NO RAY TESTS: ray is not installed; pip install 'ttscompile[ray]'"
)


class Elsewhere:
    """Does what a cluster does, in this process: parts are opened from what is sent, and several are given at once.

    Args:
        count: of a cluster.
        lasts: parts after which the cluster is gone.
    """

    def __init__(self, count: int, lasts: int | None = None) -> None:
        self.count, self.lasts, self.done = count, lasts, 0

    def map(self, work: Work, parts: Sequence[Any]) -> Iterator[Any]:
        run = work.elsewhere(*work.given)
        for part in parts:
            if self.done == self.lasts:
                raise ClusterError("the cluster is gone")
            self.done += 1
            yield run(part)
