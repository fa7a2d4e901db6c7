"""Schedules of whole steps, each gone once: what two of them have in common at their beginning is not gone again.

Up to the first step in which they differ, two schedules make the same samples and get the same corrections, so the
places where they may part are kept. All placements of three steps among 16 take a third of the evaluations so.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..core.lattice import PlanArray, Source
from ..pool import workers
from .sparse_loop import Place, SparseLoop

BYTES = 2**29
"""What kept places may hold of samples and residuals; those that were longest of no use go first."""


class ScheduleRuns:
    """The way of schedules through a sparse loop."""

    def __init__(self, loop: SparseLoop, steps: int, blocks: int, bytes_: int = BYTES) -> None:
        self._loop, self._steps, self._bytes = loop, steps, bytes_
        self._computed: PlanArray = np.full((1, blocks), Source.COMPUTE, np.int8)
        self._idle: PlanArray = np.full((1, blocks), Source.TIMESTEP, np.int8)
        self._kept: dict[tuple[int, ...], list[Place]] = {}

    def end(self, steps: Sequence[int]) -> Place:
        """The place after the last step of the schedule that computes these, the first of which is 0."""
        *before, last = steps
        with workers() as pool:
            for count in range(1, len(before) + 1):
                self._go(tuple(before[:count]), steps[count], pool)
            place = self._loop.after(self._parting(tuple(before), last), self._computed, pool)
            while place.step < self._steps:
                place = self._loop.after(place, self._idle, pool)
        self._forget()
        return place

    def _parting(self, before: tuple[int, ...], step: int) -> Place:
        """Where a schedule is before a step, after having computed some."""
        return self._kept[before][step - before[-1] - 1] if before else self._loop.begin

    def _go(self, steps: tuple[int, ...], to: int, pool: ThreadPoolExecutor) -> None:
        """Compute the last of these steps, and no other one up to a later step; keep all places from there to that."""
        places = self._kept.pop(steps, [])
        self._kept[steps] = places  # the last of them is the one that was of use last
        if not places:
            places.append(self._loop.after(self._parting(steps[:-1], steps[-1]), self._computed, pool))
        while places[-1].step < to:
            places.append(self._loop.after(places[-1], self._idle, pool))

    def _forget(self) -> None:
        """Leave out what there is no room for."""
        held = {
            steps: sum({id(one): one.nbytes for place in places for one in place.held}.values())
            for steps, places in self._kept.items()
        }
        for steps in list(held):
            if sum(held.values()) <= self._bytes:
                return
            del held[steps], self._kept[steps]
