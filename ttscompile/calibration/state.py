"""What a calibration has done so far: a file in the artifact's directory."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..artifact import tensors
from ..artifact.files import replace_file
from ..artifact.strict_json import Value
from ..core.coercion import Array, Arrays
from ..core.untrusted_json import parse_json
from ..errors import ArtifactError, CalibrationError

FILE = "calibration-state.safetensors"
"""Never listed in the manifest: an artifact is complete without it. It is removed when calibration ends, but for one of
loops that ends with the original."""

MAX_TEXT_BYTES = 16 * 2**20

_SETTINGS, _PROGRESS, _CHECKSUM = "json/settings", "json/progress", "sha256"


class StateFile:
    """The state of one calibration.

    Args:
        directory: of the artifact; None keeps nothing beyond the process.
        settings: everything that the outcome depends on; JSON. A state with other settings is not continued.

    Attributes:
        progress: how far the work is, as JSON.
        WORK, AGAIN: what errors call the work, and how to do it again; a subclass has its own.
    """

    WORK, AGAIN = "calibration", "Calibrate"

    def __init__(self, directory: Path | None, settings: Mapping[str, Any]) -> None:
        self._path = None if directory is None else directory / f"{self.WORK}-state.safetensors"
        self._settings = json.dumps(settings, sort_keys=True)
        self.arrays: dict[str, Array] = {}
        self.progress: dict[str, Any] = {}

    def load(self) -> bool:
        """Read what an earlier run left; whether there was anything. That of a run with other settings is refused.

        Raises:
            CalibrationError: it is damaged, or belongs to a run with other settings.
        """
        if self._path is None or not self._path.exists():
            return False
        try:
            arrays = {name: np.array(array) for name, array in tensors.read(self._path).items()}
            found_sum = arrays.pop(_CHECKSUM, np.zeros(0)).tobytes()
            if found_sum != _checksum(arrays):
                raise ArtifactError("expected the checksum of its content; found another: it was damaged")
            settings, progress = (_members(arrays.pop(name, None), name) for name in (_SETTINGS, _PROGRESS))
            _check_progress(Value(progress, _PROGRESS))
        except (ArtifactError, ValueError) as error:
            raise CalibrationError(
                f"{self._path}: cannot be read ({error}). {self.AGAIN} again without --resume: that begins anew."
            ) from error
        asked = json.loads(self._settings)
        if settings != asked:
            keys = [key for key in {**asked, **settings} if settings.get(key) != asked.get(key)]
            differing = {key: (settings.get(key), asked.get(key)) for key in keys}
            told = "; ".join(f"{key} was {was}, now {now}" for key, (was, now) in differing.items())
            raise CalibrationError(
                f"{self._path}: the {self.WORK} that was interrupted had other settings: {told}. Give the same ones to"
                " resume it, or leave --resume out to begin anew."
            )
        self.arrays, self.progress = arrays, progress
        return True

    def save(self, **progress: Any) -> None:
        """Write everything with this progress, at once or not at all. Raises CalibrationError: it cannot be written."""
        self.progress |= progress
        if self._path is None:
            return
        texts = {_SETTINGS: self._settings, _PROGRESS: json.dumps(self.progress, sort_keys=True)}
        content = {name: np.frombuffer(text.encode(), np.uint8) for name, text in texts.items()}
        arrays = {**self.arrays, **content}
        arrays[_CHECKSUM] = np.frombuffer(_checksum(arrays), np.uint8)
        try:
            replace_file(self._path, tensors.serialize(arrays))
        except OSError as error:
            raise CalibrationError(
                f"{self._path}: the state of the {self.WORK} cannot be written: {error}. What was saved before is as it"
                " was: make room, and go on from there with --resume."
            ) from error

    def remove(self) -> None:
        """Forget everything. Raises CalibrationError: the directory cannot be written."""
        if self._path is None:
            return
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            raise CalibrationError(
                f"{self._path}: cannot be removed: {error}. Give an artifact that can be written."
            ) from error
        self.arrays, self.progress = {}, {}

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Within the block an error is one of the state: it has everything that was written, and yet does not fit."""
        try:
            yield
        except (LookupError, TypeError, ValueError, RuntimeError) as error:
            raise CalibrationError(
                f"{self._path}: does not fit this {self.WORK} ({str(error)[:200]}). {self.AGAIN} again without"
                " --resume: that begins anew."
            ) from error

    def put(self, prefix: str, arrays: Arrays) -> None:
        """Replace all arrays below a prefix."""
        self.arrays = {name: array for name, array in self.arrays.items() if not name.startswith(f"{prefix}/")}
        self.arrays.update({f"{prefix}/{name}": array for name, array in arrays.items()})

    def get(self, prefix: str) -> dict[str, Array]:
        """All arrays below a prefix, by the rest of their names."""
        return {n.removeprefix(f"{prefix}/"): a for n, a in self.arrays.items() if n.startswith(f"{prefix}/")}


def _checksum(arrays: Arrays) -> bytes:
    """The sha256 of names, types and contents, whatever their order."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name!r} {array.dtype.str} {np.shape(arrays[name])}\n".encode())
        digest.update(array.tobytes())
    return digest.digest()


def _members(array: Array | None, name: str) -> dict[str, Any]:
    """The JSON object that an array holds as bytes; errors of plans may be NaN in it."""
    content = b"" if array is None else array.tobytes()
    try:
        document = parse_json(content, MAX_TEXT_BYTES, allow_nan=True)
    except ValueError as error:
        raise ArtifactError(f"{name}: expected a JSON document; {error}") from error
    return {key: value.data for key, value in Value(document, name).members().items()}


def _check_progress(progress: Value) -> None:
    """Raise unless the numbers that all work of a kind reads are such numbers."""
    members = progress.members()
    for name in {"seconds", "training began"} & set(members):
        if members[name].number() < 0:
            members[name].fail("a time that is not negative")
    counts = ("calls", "updates", "intervals", "targets", "observations")
    for name in (name for name in members if name.endswith(counts)):
        members[name].integer()
    if "latency" in members:
        fields = members["latency"].keys("cells", "measured")
        fields["cells"].integer(1)
        fields["measured"].members()
