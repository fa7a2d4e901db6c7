"""What a calibration has done so far, in one file in the artifact's directory, so that it can be killed and go on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact import tensors
from ..artifact.files import replace_file
from ..errors import ArtifactError, CalibrationError

Array = npt.NDArray[Any]

FILE = "calibration-state.safetensors"
"""Never listed in the manifest: an artifact is complete without it, and it is removed when calibration ends."""

_SETTINGS, _PROGRESS = "json/settings", "json/progress"


class StateFile:
    """The state of one calibration.

    Args:
        directory: of the artifact.
        settings: everything that the outcome depends on; JSON. A state with other settings is not continued.

    Attributes:
        arrays: by name.
        progress: numbers; JSON.
    """

    def __init__(self, directory: Path, settings: Mapping[str, Any]) -> None:
        self._path = directory / FILE
        self._settings = json.dumps(settings, sort_keys=True)
        self.arrays: dict[str, Array] = {}
        self.progress: dict[str, Any] = {}

    def load(self) -> bool:
        """Read what an earlier calibration left.

        Returns:
            Whether there was anything.

        Raises:
            CalibrationError: it is damaged, or belongs to a calibration with other settings.
        """
        if not self._path.exists():
            return False
        try:
            arrays = {name: np.array(array) for name, array in tensors.read(self._path).items()}
            settings, progress = (bytes(arrays.pop(name)).decode() for name in (_SETTINGS, _PROGRESS))
            self.progress = dict(json.loads(progress))
        except (ArtifactError, KeyError, ValueError) as error:
            raise CalibrationError(
                f"{self._path}: cannot be read ({error}). Calibrate again without --resume: that begins anew."
            ) from error
        if settings != self._settings:
            found, asked = json.loads(settings), json.loads(self._settings)
            differing = {key: (found.get(key), asked.get(key)) for key in asked if found.get(key) != asked.get(key)}
            told = "; ".join(f"{key} was {was}, now {now}" for key, (was, now) in differing.items())
            raise CalibrationError(
                f"{self._path}: the calibration that was interrupted had other settings: {told}. Give the same ones to"
                " resume it, or leave --resume out to begin anew."
            )
        self.arrays = arrays
        return True

    def save(self) -> None:
        """Write everything, at once or not at all.

        Raises:
            CalibrationError: the directory cannot be written.
        """
        texts = {_SETTINGS: self._settings, _PROGRESS: json.dumps(self.progress, sort_keys=True)}
        content = {name: np.frombuffer(text.encode(), np.uint8) for name, text in texts.items()}
        try:
            replace_file(self._path, tensors.serialize({**self.arrays, **content}))
        except OSError as error:
            raise CalibrationError(f"{self._path}: the state of the calibration cannot be written: {error}.") from error

    def remove(self) -> None:
        """Forget everything."""
        self._path.unlink(missing_ok=True)
        self.arrays, self.progress = {}, {}

    def put(self, prefix: str, arrays: Mapping[str, Array]) -> None:
        """Replace all arrays below a prefix."""
        self.arrays = {name: array for name, array in self.arrays.items() if not name.startswith(f"{prefix}/")}
        self.arrays.update({f"{prefix}/{name}": array for name, array in arrays.items()})

    def get(self, prefix: str) -> dict[str, Array]:
        """All arrays below a prefix, by the rest of their names."""
        return {n.removeprefix(f"{prefix}/"): a for n, a in self.arrays.items() if n.startswith(f"{prefix}/")}
