"""Searches of a comparison that are done: kept in the artifact's directory until it ends, so that it can go on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..artifact.manifest import Manifest
from ..core.correction import Correction
from ..core.lattice import check_plan
from ..errors import CalibrationError
from .state import COMPARISON, StateFile
from .task import Found

Outcome = dict[str, tuple[Found, bool] | str]
"""By series: what was found and whether the time cut that short, or why there is nothing."""

_FIELDS = tuple(field.name for field in fields(Correction))


class Searches:
    """What is known before a search begins, and what it finds.

    Args:
        path: of the artifact; of one that is zipped, or cannot be written, nothing is kept.
        manifest: of the artifact.
        settings: everything that the outcomes depend on; JSON.
        resume: go on from what an interrupted comparison left, if there is anything.

    Attributes:
        warning: why nothing is kept; empty where it is.

    Raises:
        CalibrationError: what is there is damaged, or of other settings.
    """

    def __init__(self, path: Path, manifest: Manifest, settings: Mapping[str, Any], resume: bool) -> None:
        self._shape = manifest.steps, len(manifest.blocks)
        self._state = StateFile(path, settings, COMPARISON)
        self.warning = "" if path.is_dir() else "its artifact is no directory"
        if not self.warning and not (resume and self._state.load()):
            self._state.remove()
        with self._state.reading():
            self._told: dict[str, Any] = self._state.progress.setdefault("searches", {})
            if not isinstance(self._told, dict) or not all(isinstance(each, dict) for each in self._told.values()):
                raise ValueError("expected searches by name")

    def dense(self, calls: int, shape: tuple[int, ...]) -> torch.Tensor:
        """What the dense policy answered to the first of the calls to learn from.

        Args:
            calls: N.
            shape: of one answer, ``(K, T, D)``.

        Returns:
            ``[n, K, T, D]``, n from 0 to N.
        """
        found = self._state.get("dense").get("path", np.zeros((0, *shape), np.float32))
        with self._state.reading():
            if found.shape[1:] != shape or found.dtype != np.float32 or len(found) > calls:
                raise ValueError(f"expected answers float32 [n, {shape}]; found {found.dtype} {found.shape}")
            return torch.from_numpy(found)

    def keep_dense(self, path: torch.Tensor) -> None:
        """Keep the answers so far."""
        self._state.put("dense", {"path": path.numpy()})
        self._save()

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
        self._save()

    def end(self) -> None:
        """Forget everything: the comparison is done."""
        if not self.warning:
            self._state.remove()

    def _save(self) -> None:
        if self.warning:
            return
        try:
            self._state.save()
        except CalibrationError as error:
            self.warning = str(error)
