"""Whole steps as ``tts`` places them, from which the pruner may then depart (``adaptation``).

That never made a plan better that could be told from chance (``docs/evidence/ablation.md``), so ``tts`` does without.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..calibration.pruner.head import has_head
from ..calibration.task import Array, Found, Task
from ..calibration.tts import Tts
from .adaptation import Adaptation


class Switched(Tts):
    """The search of ``Tts``, and after it the switches, where the artifact has a pruner; see ``Search``."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self._adaptation: Adaptation | None = None
        self.closing = Adaptation.INTERVALS if has_head(task.pruner) else 0
        self.intervals += self.closing

    @property
    def done(self) -> bool:
        """Whether the schedule is settled, and the pruner fitted to it where it may be."""
        return super().done and (self._adaptation is None or self._adaptation.done)

    def close(self) -> None:
        """Settle the schedule, and begin with the switches."""
        super().close()
        if self._adaptation is None and self.closing and (found := self._settled) is not None:
            corrected = replace(self._task, executor=self._task.executor.corrected(found.correction))
            self._adaptation = Adaptation(corrected, found.schedule)

    def advance(self, interval: int) -> None:
        """Go on with the schedule; or adapt the plan to observations."""
        if self._adaptation is None:
            super().advance(interval)
        else:
            self._adaptation.advance()

    def state(self) -> dict[str, Array]:
        """See ``Tts``; and what the switches are so far."""
        return {**super().state(), **({} if self._adaptation is None else self._adaptation.state())}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go back to where ``state`` was taken."""
        super().restore(state)
        if self._adaptation is not None:
            self._adaptation.restore(state)

    def found(self) -> Found:
        """The schedule with its correction, and the pruner if plans that depend on the observation were better."""
        found = super().found()
        if self._adaptation is None:
            return found
        notes = {**found.notes, "switches": self._adaptation.switches}
        return replace(found, notes=notes, pruner=self._adaptation.pruner, pruner_correction=found.correction)
