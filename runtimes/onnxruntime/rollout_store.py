"""Entries of the rollout cache: copies of computed residuals that a later call of the episode can read."""

from __future__ import annotations

import numpy as np

from .sessions import Array


class RolloutStore:
    """Memory is taken when an entry is kept for the first time, and stays for the next episodes.

    Args:
        shape: of a residual of all streams.
        axis: of the streams in it.

    Attributes:
        entries: by flat index ``k * blocks + b``.
    """

    def __init__(self, shape: tuple[int, ...], axis: int) -> None:
        self._shape, self._axis = shape, axis
        self.entries: dict[int, Array] = {}

    def entry(self, cell: int) -> Array:
        """The entry of a cell; a new one holds zeros."""
        found = self.entries.get(cell)
        if found is None:
            found = self.entries[cell] = np.empty(self._shape, np.float32)
            found.fill(0.0)  # commits its pages now
        return found

    def of_stream(self, cell: int, s: int) -> Array:
        """One stream's part of an entry, as a view."""
        view: Array = np.moveaxis(self.entry(cell), self._axis, 0)[s]
        return view

    @property
    def nbytes(self) -> int:
        """Memory of the entries."""
        return sum(entry.nbytes for entry in self.entries.values())
