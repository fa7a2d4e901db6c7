"""Recorded episodes as calls of the policy, for calibration. ``docs/design.md`` section 8 has the formats.

An ``.npz`` with one array for each key of the observation and ``episode_ends [E]``: rows are calls ``[N, To, ...]``, in
order; or, with ``{"frames": true}`` in its ``meta``, frames ``[F, ...]``, from which the windows are cut here. A zarr
replay buffer of Diffusion Policy, an HDF5 file of robomimic and a LeRobot data set hold frames.
"""

import hashlib
import os
import warnings
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..core.coercion import Array, Arrays, integer
from ..core.paths import on_hub, require_path
from ..core.spec import Instruction, ObservationSpec, PolicySpec
from ..core.tokenizer import TASK, ReadTokenizer, Tokenizer
from ..core.untrusted_json import parse_json
from ..core.values import check_values, fitted
from ..core.zip_files import open_zip
from ..errors import TrajectoryError
from ..hub import fetch_recording
from ..hub.repository import MOST_EPISODES
from .frames import Frames, few, frames_of_calls, instruction_rows, observation_frames, one_error, require_proportion
from .sandbox import sandboxed_frames

ENDS, META = "episode_ends", "meta"
MAX_META = 2**20
"""Bytes of ``meta``."""


@dataclass(frozen=True)
class Episode:
    """Consecutive calls between two resets.

    Attributes:
        name: file and number, for messages.
        observations: by key ``[R, *shape]``, one row a call in order, of the specification's dtype, not normalised.
    """

    name: str
    observations: Arrays

    @property
    def calls(self) -> int:
        """R, the number of calls."""
        return len(next(iter(self.observations.values())))


def load_trajectories(
    paths: Sequence[str | os.PathLike[str]],
    observations: Mapping[str, ObservationSpec],
    action_steps: int,
    sources: Mapping[str, Sequence[str]] | None = None,
    instruction: Instruction | None = None,
    tokenizer: ReadTokenizer | None = None,
) -> list[Episode]:
    """Read episodes from files.

    Args:
        paths: of files and directories, or ``hf://datasets/org/name``: of a LeRobot data set, the first episodes.
        action_steps: how many actions of a chunk are executed: the frames between two calls.
        sources: by key of the observation, the arrays of a recording of frames that it is made of, in order, where they
            are called otherwise than the key, or than its specification says (``recorded``); ``NAME:N`` are the first N
            numbers of one. With ``task``, the path of a tokenizer, recorded instructions are made the policy's tokens.
        instruction: how the policy is told its task in words.
        tokenizer: makes recorded instructions tokens where ``sources`` names none and no tokens were recorded.

    Returns:
        The episodes in the order of the files. Rows after the last end of an episode are left out, with a warning; so
        is an episode that equals one before it.

    Raises:
        TrajectoryError: names the file, what was expected, what it holds, and what to do.
    """
    action_steps = integer(action_steps, "action_steps", TrajectoryError, 1)
    if isinstance(paths, str | os.PathLike) or not isinstance(paths, Iterable):
        paths = [paths]
    if no_path := [type(path).__name__ for path in paths if not isinstance(path, str | os.PathLike)]:
        raise TrajectoryError(f"expected paths of recordings; found a {no_path[0]}. {_SAVEZ}, and give the file.")
    if not paths:
        raise TrajectoryError("no trajectory files were given. Name at least one .npz with recorded episodes.")
    different: dict[bytes, Episode] = {}  # one that is there twice could be learned from and held out at once
    again = []
    how = observations, action_steps, sources or {}, instruction, tokenizer
    read = [(path, _read(path, *how)) for path in paths]
    for path, found in read:
        if on_hub(path):
            warnings.warn(f"{path}: its first {len(found)} episodes are read.", stacklevel=2)
    for episode in [each for _, found in read for each in found]:
        digest = hashlib.sha256()
        for _, array in sorted(episode.observations.items()):
            digest.update(np.ascontiguousarray(array).data)
        if different.setdefault(digest.digest(), episode) is not episode:
            again.append(episode.name)
    if again:
        told = ", ".join(again[:5]) + ", .." * (len(again) > 5)
        warnings.warn(f"episodes that were given before are left out: {told}.", stacklevel=2)
    return list(different.values())


def episodes_of(
    spec: PolicySpec,
    paths: Sequence[str | os.PathLike[str]],
    sources: Mapping[str, Sequence[str]] | None = None,
    tokenizer: ReadTokenizer | None = None,
) -> list[Episode]:
    """Recorded episodes as a policy observes them, with a call for each chunk that it executes."""
    return load_trajectories(paths, spec.observations, spec.chunk.executes, sources, spec.instruction, tokenizer)


def local_path(path: str | os.PathLike[str]) -> Path:
    """Where a recording is on this machine; of a data set on the hub the first episodes are downloaded."""
    return fetch_recording(os.fspath(path)) if on_hub(path) else Path(path)


def _read(
    recording: str | os.PathLike[str],
    observations: Mapping[str, ObservationSpec],
    action_steps: int,
    sources: Mapping[str, Sequence[str]],
    instruction: Instruction | None,
    tokenizer: ReadTokenizer | None,
) -> list[Episode]:
    """The episodes of one recording: what the policy observes, of arrays that may be called otherwise, and of texts."""
    path, limits = local_path(recording), {"most": MOST_EPISODES} if on_hub(recording) else {}
    folder, sources = sources.get(TASK), {key: parts for key, parts in sources.items() if key != TASK}
    if folder is not None and instruction is None:
        told = f"{folder[0]}: this policy takes no text that alone would give its tokens. Leave the tokenizer out"
        raise TrajectoryError(f"{told}, and record tokens if it observes any.")
    tokenizer = tokenizer if folder is None else partial(Tokenizer, folder[0])
    recorded = array_names(observations, {key: (key, *spec.recorded) for key, spec in observations.items()})
    kind, held, frames = _opened(path, limits, sorted({*recorded, *array_names(observations, sources), TASK}))
    sources = default_sources(observations, held.names, frames) | sources
    words = instruction if folder is not None or (tokenizer and _in_text_alone(held, instruction, sources)) else None
    seen = {key: spec for key, spec in observations.items() if words is None or key not in (words.tokens, words.mask)}
    used = array_names(seen, sources) | ({TASK} if words else set()) | {"action"}  # which demonstrations have, too
    if sources and not frames:
        told = f"{path}: its rows are calls of the policy, and {sorted(sources)} are to be made of other arrays, which"
        raise TrajectoryError(f"{told} is for frames. Save each key of the observation as an array of its own.")
    if unknown := sorted(set(sources) - set(observations)):
        raise TrajectoryError(f"the policy observes {sorted(observations)}; found arrays for {unknown}.")
    ends = _ends(path, held.ends)
    if kind == "lerobot" and all((spec.frames or 1) == 1 for spec in observations.values()):
        held, action_steps = frames_of_calls(held, action_steps), 1
        ends = _ends(path, held.ends)
    arrays = observation_frames(path, held, seen, sources)
    if words and tokenizer:
        arrays |= instruction_rows(path, held, words, observations, tokenizer, arrays)
    if kind is None and (extra := sorted(set(held.names) - used)):
        warnings.warn(f"{path}: arrays {extra} are no keys of the observation, and are not used.", stacklevel=4)
    return _cut(path, arrays, ends, observations, action_steps if frames else None)


def _cut(
    path: Path, arrays: Arrays, ends: list[int], specs: Mapping[str, ObservationSpec], by: int | None
) -> list[Episode]:
    """Arrays ``[N, ...]`` by key as episodes: checked, and cut where each ends.

    Rows are frames, of which every ``by``-th is the newest of a call; or calls if that is None.
    """
    rows = {len(arrays[key]) if arrays[key].ndim else 0 for key in specs}
    if len(rows) != 1:
        lengths = {key: arrays[key].shape for key in specs}
        raise TrajectoryError(f"{path}: observations differ in length: {lengths}. Each needs a row for every call.")
    count = rows.pop()
    if ends[-1] > count:
        told = f"{path}: {ENDS} says that the last episode ends at row {ends[-1]}, but there are {count} rows: no such"
        raise TrajectoryError(f"{told} episode is complete. Record it again, or leave the episode out of {ENDS}.")
    if ends[-1] < count:
        warnings.warn(f"{path}: {count - ends[-1]} rows after the last end of an episode are not used.", stacklevel=5)
    checked = {key: _checked(path, key, arrays[key], spec, by is not None) for key, spec in specs.items()}
    episodes = []
    for number, (start, end) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        part = {key: array[start:end] for key, array in checked.items()}
        if by is not None:
            part = {key: _windows(array, specs[key].frames, by) for key, array in part.items()}
        episodes.append(Episode(f"{path.name}[{number}]", part))
    return episodes


def array_names(keys: Iterable[str], sources: Mapping[str, Sequence[str]]) -> set[str]:
    """Names of the arrays of a recording that these keys of the observation are made of."""
    return {part.partition(":")[0] for key in keys for part in sources.get(key, (key,))}


def default_sources(
    observations: Mapping[str, ObservationSpec], names: Sequence[str], frames: bool
) -> dict[str, Sequence[str]]:
    """By key the arrays that training made it of, where a recording of frames has them and none of the key's name."""
    made = {key: spec.recorded for key, spec in observations.items() if frames and key not in names}
    return {key: parts for key, parts in made.items() if parts and array_names([key], made) <= {*names}}


def _in_text_alone(held: Frames, instruction: Instruction | None, sources: Mapping[str, Sequence[str]]) -> bool:
    """Whether a recording says the task in words, and has no tokens of them, nor what they are to be made of."""
    names = {*held.names, *sources}
    return instruction is not None and TASK in held.names and names.isdisjoint((instruction.tokens, instruction.mask))


def recorded_names(path: Path) -> tuple[list[str], bool]:
    """Names of the arrays of a recording, and whether its rows are frames rather than calls."""
    _, held, frames = _opened(path, {}, [])
    return list(held.names), frames


def _opened(path: Path, limits: Mapping[str, int], wanted: Sequence[str]) -> tuple[str | None, Frames, bool]:
    """What a recording is (None for an ``.npz``), what it holds, and whether its rows are frames."""
    require_path(path, TrajectoryError, "Give a recording, or hf://datasets/ORGANISATION/NAME.")
    kind = other_format(path)
    return kind, *(_npz(path) if kind is None else (sandboxed_frames(path, kind, wanted, **limits), True))


def _npz(path: Path) -> tuple[Frames, bool]:
    arrays = read_npz(path)
    frames = meta_of(path, arrays.pop(META, None)).get("frames", False)
    if not isinstance(frames, bool):
        raise TrajectoryError(f"{path}: frames of {META!r} is {frames!r:.80}; expected true or false.")
    if ENDS not in arrays:
        told = f"{path}: has no array {ENDS!r}; it has {few(sorted(arrays)) or 'no arrays at all'}"
        raise TrajectoryError(f"{told}. Add {ENDS} [E]: {_ENDS_ARE}.")
    ends = arrays.pop(ENDS)
    return Frames(sorted(arrays), arrays.__getitem__, ends), frames


_ENDS_ARE = "for each episode the row after its last, increasing"
_SAVEZ = "Use np.savez with plain arrays"


def read_npz(path: Path, only: str = "") -> dict[str, Array]:
    """All arrays of an ``.npz``, or the one of a name if it is there, without unpickling anything."""
    require_path(path, TrajectoryError, "Give the .npz file of a recording.")
    if not path.is_file():
        raise TrajectoryError(
            f"{path}: expected an .npz, a zarr replay buffer of Diffusion Policy, an HDF5 file of robomimic or a"
            " LeRobot data set; found a directory that is none of these."
        )
    hint = f": truncated, or with Python objects in it, which are never loaded. Record it again. {_SAVEZ}"
    with path.open("rb") as handle:
        head = handle.read(6)
    if not head.startswith((b"PK", b"\x93NUMPY")):
        found = f"one that begins with {head!r}" if head else "an empty one"
        raise TrajectoryError(f"{path}: expected an .npz, or the folder of a data set; found {found}. {_SAVEZ}.")
    # numpy parses headers as Python text, and raises whatever its parts raise; it leaves open what is no archive.
    with one_error(f"{path}: cannot be read as .npz", hint), path.open("rb") as handle:
        if zipfile.is_zipfile(handle):
            open_zip(handle).close()  # which numpy does without a limit
        handle.seek(0)
        file = np.load(handle, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise TrajectoryError(f"{path}: expected an .npz with several arrays; found a single one. {_SAVEZ}.")
        with file:
            archive: Any = file.zip  # nothing has been decompressed yet
            total = sum(entry.file_size for entry in archive.infolist())
            require_proportion(path, total, path.stat().st_size)
            return {name: np.asarray(file[name]) for name in file.files if only in ("", name)}


def other_format(path: Path) -> str | None:
    """``zarr``, ``hdf5`` or ``lerobot``; None for what can only be an ``.npz``."""
    name = path.name.lower()
    if not path.exists():
        return None
    if name.endswith((".zarr", ".zarr.zip")) or (path / ".zgroup").exists() or (path / "zarr.json").exists():
        return "zarr"
    if name.endswith((".hdf5", ".h5")):
        return "hdf5"
    return "lerobot" if (path / "meta" / "info.json").exists() else None


def meta_of(path: Path, value: Array | None) -> dict[str, Any]:
    """What the array ``meta`` of an ``.npz`` says of it; nothing where there is none."""
    meta: Any = {} if value is None else None
    if value is not None and value.ndim == 0 and value.dtype.kind in "SU":
        text = value.item()
        with suppress(ValueError):
            meta = parse_json(text if isinstance(text, bytes) else text.encode(), MAX_META)
    if not isinstance(meta, dict):
        told = f"{path}: expected {META!r} to be a JSON object in a string array, such as '{{\"frames\": true}}'"
        raise TrajectoryError(f"{told}; found {str(value)[:80]!r}.")
    return meta


def _ends(path: Path, ends: Array) -> list[int]:
    if ends.ndim != 1 or ends.dtype.kind not in "iu":
        raise TrajectoryError(f"{path}: {ENDS} is {ends.dtype}{list(ends.shape)}; expected integers [E], {_ENDS_ARE}.")
    found = [int(end) for end in ends]
    if not found:
        raise TrajectoryError(f"{path}: {ENDS} is empty: no episode is complete. Record at least two whole episodes.")
    if any(b <= a for a, b in zip([0, *found[:-1]], found, strict=True)):
        raise TrajectoryError(f"{path}: {ENDS} is {found[:8]}...; expected {_ENDS_ARE}, the first of them above 0.")
    return found


def _checked(path: Path, key: str, array: Array, spec: ObservationSpec, frames: bool) -> Array:
    """The array in the specification's dtype, of its shape, and finite."""
    frames = frames and spec.frames is not None
    shape, what = (spec.shape[1:], "[F, *frame]") if frames else (spec.shape, "[N, *shape]")
    if array.dtype.kind == "f" and spec.fit is not None:
        with np.errstate(over="ignore"):
            single = array.astype(np.float32)
        array = fitted(single, spec, f"{path}: {key!r}", TrajectoryError)
    if array.shape[1:] != shape:
        told = f"{path}: {key!r} has shape {list(array.shape)}; expected {what} = [.., {', '.join(map(str, shape))}]."
        if array.shape[1:] == spec.shape[1:] and not frames:
            told += " If its rows are frames, say so: np.savez(..., meta=np.array('{\"frames\": true}'))."
        elif array.shape[1:] == (1, *shape):
            told += f" Save it without the axis of streams: {key}[:, 0]."
        elif spec.image:
            last = array.shape[1:] == (*shape[:-3], *shape[-2:], shape[-3])
            told += " Its channels are last: use np.moveaxis(image, -1, -3)." if last else " Is it another camera's?"
        else:
            told += " Give what this policy observes; --observation KEY=NAME:N takes the first N numbers of an array."
        raise TrajectoryError(told)
    wanted = np.dtype(spec.dtype)
    allowed = "fiu" if wanted.kind == "f" else wanted.kind if wanted.kind not in "iu" else "iu"
    if array.dtype.kind not in allowed:
        raise TrajectoryError(f"{path}: {key!r} has dtype {array.dtype}; expected {wanted}. Convert it with astype.")
    with np.errstate(over="ignore"):
        cast = array.astype(wanted)
    if wanted.kind != "f" and not np.array_equal(cast, array):
        raise TrajectoryError(f"{path}: {key!r} holds numbers that {wanted} cannot; expected values of that dtype.")
    if wanted.kind == "f" and not np.isfinite(cast).all():
        bad = np.flatnonzero(~np.isfinite(cast.reshape(len(cast), -1)).all(1))
        told = f"{path}: {key!r} holds NaN or infinity in {len(bad)} rows, the first of them row {bad[0]}"
        raise TrajectoryError(f"{told}. Leave the episodes with broken sensors out.")
    if cast.size:
        check_values(cast, spec, f"{path}: {key!r}", TrajectoryError)
    return cast


def _windows(frames: Array, length: int | None, stride: int) -> Array:
    """What the policy saw when it was called: the last ``length`` frames, every ``stride`` frames; None: the newest.

    At the start of an episode the first frame stands for those before it, as in Diffusion Policy's environments.
    """
    calls = np.arange(0, len(frames), stride)
    if length is None:
        return frames[calls]
    windows: Array = frames[np.maximum(calls[:, None] + np.arange(1 - length, 1), 0)]
    return windows
