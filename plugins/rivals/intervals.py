"""What searches of rivals have in common: they keep their best plan throughout, and have nothing to do at the end."""

from __future__ import annotations


class NothingAfter:
    """What a ``Search`` says that has nothing left to do after its intervals."""

    intervals = 1
    settling = 0.0
    _interval = 0  # how many were done

    @property
    def done(self) -> bool:
        """Whether all intervals were done."""
        return self._interval >= self.intervals
