"""Searches of a comparison that are done: kept in the artifact's directory until it ends, so that it can go on."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from ..core.correction import Correction
from ..core.lattice import check_plan
from .state import StateFile
from .task import Found

Outcome = dict[str, tuple[Found, bool] | str]
"""By series: what was found and whether the time cut that short, or why there is nothing."""

_FIELDS = tuple(field.name for field in fields(Correction))


class Searches:
    """What is known before a search begins, and what it finds.

    Args:
        state: of the comparison.
        shape: K and number of blocks.

    Raises:
        CalibrationError: what is there is damaged.
    """

    def __init__(self, state: StateFile, shape: tuple[int, int]) -> None:
        self._state, self._shape = state, shape
        with state.reading():
            self._told: dict[str, Any] = state.progress.setdefault("searches", {})
            if not isinstance(self._told, dict) or not all(isinstance(each, dict) for each in self._told.values()):
                raise ValueError("expected searches by name")

    def known(self, strategy: str, cells: int) -> Outcome | None:
        """What a search found before; None if it was not done."""
        key, outcome = f"{strategy} {cells}", Outcome()
        with self._state.reading():
            told = self._told.get(key)
            if told is None:
                return None
            for series, one in told.items():
                if isinstance(one, str):
                    outcome[series] = one
                    continue
                arrays = self._state.get(f"{key}/{series}")
                correction = Correction(*(arrays[name] for name in _FIELDS)) if _FIELDS[0] in arrays else None
                schedule = check_plan(arrays["schedule"], *self._shape, 1)[0]
                outcome[series] = (
                    Found(schedule, dict(one["notes"]), correction, error=float(one["error"])),
                    bool(one["cut"]),
                )
        return outcome

    def keep(self, strategy: str, cells: int, outcome: Outcome) -> None:
        """Keep what a search found."""
        key, told = f"{strategy} {cells}", dict[str, Any]()
        for series, one in outcome.items():
            if isinstance(one, str):
                told[series] = one
                continue
            found, cut = one
            told[series] = {"notes": dict(found.notes), "error": found.error, "cut": cut}
            correction = {} if found.correction is None else {name: getattr(found.correction, name) for name in _FIELDS}
            self._state.put(f"{key}/{series}", {"schedule": found.schedule, **correction})
        self._told[key] = told
        self._state.save()
