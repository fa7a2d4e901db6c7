"""Whole steps, placed by their true error, with a correction: the default, and the same for every observation.

Test-time sparsity (arXiv 2605.13316) has a head decide for each observation, which ``pruner.paper`` trains. This search
places whole steps, because with a correction (``fit_correction``) it is they that carry information about the
observation and the noise, and everything in between is nearly linear. Every candidate gets a correction of its own,
fitted on some of the calls, and is judged by the true error of its actions on others. It starts with a family of
crowded schedules. Where there are few others, it tries them all; else it moves one step of the best at a time, far
at first, until no move helps. The winner's correction is fitted again, on all calls.
"""

import numpy as np

from ..core.coercion import Array, Arrays
from ..core.lattice import PlanArray
from .step_counts import other_placements, spacings
from .task import Found, Task

MOVED_BY = (8, 4, 2, 1)
"""How far a step is moved, in either direction. All steps are tried at one distance before the next."""


class Tts:
    """The search of this module; its loss is that of the plan on calls that its correction was not fitted on."""

    def __init__(self, task: Task) -> None:
        self._task, self._whole = task, task.whole
        model = task.runner.model
        self._full = min(max(1, task.budget // model.blocks), model.steps)
        self._steps: tuple[int, ...] = tuple(range(self._full))
        self.loss = float("nan")
        others = other_placements(model.steps, self._full)
        self._family = [*spacings(model.steps, self._full), *(others or ())]
        self._moves = [(distance, i) for distance in MOVED_BY for i in range(1, self._full)] if others is None else []
        self.intervals = len(self._family) + len(self._moves)
        self._found: Found | None = None

    @property
    def plan(self) -> PlanArray:
        """The best schedule so far."""
        return self._whole.plan(self._steps)

    @property
    def done(self) -> bool:
        """Whether the schedule is settled."""
        return self._found is not None

    @property
    def seconds_to_finish(self) -> float:
        """The correction, if it is not fitted yet."""
        return 0.0 if self._found is not None else self._whole.correcting(self._full)

    def advance(self, interval: int) -> None:
        """Try a schedule of the family, or two moves of a step."""
        if interval < len(self._family):
            self._whole.expect(self._family[interval:])
            self._try([self._family[interval]])
        else:
            moves = self._moves[interval - len(self._family) :]
            self._whole.expect(steps for move in moves for steps in self._candidates(*move))  # if none of them helps
            self._try(self._candidates(*moves[0]))
        if interval + 1 >= self.intervals:
            self.found()

    def state(self) -> dict[str, Array]:
        """Computed steps and their error; corrections are fitted again."""
        return {
            "steps": np.array(self._steps, np.int64),
            "loss": np.array(self.loss),
            "settled": np.array(int(self._found is not None)),
        }

    def restore(self, state: Arrays) -> None:
        """Go back to where ``state`` was taken."""
        self._steps, self.loss = tuple(int(k) for k in state["steps"]), float(state["loss"])
        if state["settled"]:
            self.found()

    def found(self) -> Found:
        """The schedule with its correction, which is fitted to all calls."""
        if self._found is None:
            self._found = self._task.whole_steps(self._steps)
        return self._found

    def _candidates(self, distance: int, i: int) -> list[tuple[int, ...]]:
        """The schedules with the i-th step moved in either direction, where it can be."""
        return [steps for offset in (-distance, distance) if (steps := self._moved(i, offset)) is not None]

    def _try(self, candidates: list[tuple[int, ...]]) -> None:
        for steps in candidates:
            error = self._whole.errors(steps).normalised
            if not error >= self.loss:  # the first one beats NaN
                self._steps, self.loss = steps, error

    def _moved(self, i: int, offset: int) -> tuple[int, ...] | None:
        """The schedule with its i-th step moved; None if it would meet another, or leave the loop."""
        target = self._steps[i] + offset
        if not 0 < target < self._task.runner.model.steps or target in self._steps:
            return None
        return tuple(sorted((*self._steps[:i], target, *self._steps[i + 1 :])))
