"""Whether recordings fit a policy: names, pictures, ranges and rate; for the doctor."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..core.finding import Finding, Level
from ..core.spec import PolicySpec
from ..core.untrusted_json import parse_json
from ..errors import TrajectoryError
from .episodes import Episode, load_trajectories, recorded_names
from .frames import few, one_error
from .lerobot_dataset import MAX_INFO
from .ranges import MOST, Placed, placed, told_outside

PART = "recordings"
Sources = Mapping[str, Sequence[str]]
Means = Mapping[str, npt.NDArray[np.float64]]

BLIND_SECONDS = 3.0
"""For which a chunk is executed without looking, from which on a robot misses what happens."""
_APART = 0.05
"""Between mean pictures, of 0..1; less is the light of another day."""
_LITTLE, _DEGREES = 0.05, (20, 200)
"""Shares of the range of the training data that recorded numbers fill, where the unit is another: of radians and
degrees one is 57 times the other."""


def examine_recordings(paths: Sequence[Path], spec: PolicySpec, sources: Sources, means: Means) -> list[Finding]:
    """Look at recordings as the policy would observe them.

    Args:
        paths: see ``load_trajectories``.
        spec: of the policy.
        sources: the same.
        means: by camera the mean of each channel in training, 0..1, where that is known.
    """
    found: list[Finding] = []
    renamed = dict(sources)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            for path in paths:
                found += [*_names(path, spec, renamed), *_rate(path, spec)]
            episodes = load_trajectories(paths, spec.observations, spec.chunk.stop - spec.chunk.start, renamed)
        except TrajectoryError as error:
            told = "As the message says; nothing else was tried."
            return [*found, Finding(PART, "load", str(error), Level.PROBLEM, told)]
    found += [Finding(PART, "load", str(each.message), Level.NOTE) for each in said]
    found.append(Finding(PART, "calls", f"{sum(each.calls for each in episodes)} in {len(episodes)} episodes"))
    return [*found, *map(_range, placed(episodes, spec)), *_pictures(episodes, spec, means)]


def _names(path: Path, spec: PolicySpec, renamed: dict[str, Sequence[str]]) -> list[Finding]:
    """Keys that a recording lacks; a name that may stand for one is added to ``renamed``, and said."""
    names, frames = recorded_names(path)
    used = {part.partition(":")[0] for key in spec.observations for part in renamed.get(key, (key,))}
    missing = [key for key in spec.observations if key not in renamed and key not in names]
    free = [name for name in names if name not in used]
    if not missing:
        told = f"all that the policy observes; not read: {few(free)}" if free else "what the policy observes"
        return [Finding(PART, path.name, told)]
    pairs = _pairs(missing, [name for name in free if name.startswith(("observation", "obs")) or "." not in name])
    told = f"lacks {', '.join(missing)}; it has {few(names)}"
    remedy = "Record what the policy observes, or convert it without that camera (--without-camera)."
    if pairs and frames:
        renamed |= {key: (name,) for key, name in pairs.items()}
        words = " ".join(f"--observation {key}={name}" for key, name in pairs.items())
        remedy = f"If these are the same, say so: {words}. With lerobot it is rename_map. The rest was tried so."
    elif pairs:
        remedy = f"If these are the same, save {', '.join(f'{name} as {key}' for key, name in pairs.items())}."
    return [Finding(PART, path.name, told, Level.PROBLEM, remedy)]


def _pairs(missing: Sequence[str], free: Sequence[str]) -> dict[str, str]:
    """By key the name of the same group that may stand for it: the one most like it, or the last for the last."""
    found: dict[str, str] = {}
    for key in (*missing, *missing):  # what is left the second time
        group, _, last = key.rpartition(".")
        left = {name.rpartition(".")[2]: name for name in free if name not in found.values() and name.startswith(group)}
        like = [each for each in left if last in each or each in last] or get_close_matches(last, left, 1)
        if not like and len([each for each in missing if each not in found and each.startswith(group)]) == 1:
            like = list(left)
        if key not in found and len(like) == 1:
            found[key] = left[like[0]]
    return found


def _rate(path: Path, spec: PolicySpec) -> list[Finding]:
    """How long a chunk is, where a data set says its rate."""
    info = path / "meta" / "info.json"
    if not info.is_file():
        return []
    with one_error(f"{path}: meta/info.json cannot be read"):
        rate = float(parse_json(info.read_bytes(), MAX_INFO)["fps"])
        executed = spec.chunk.stop - spec.chunk.start
        told = f"{rate:g} Hz: {executed} steps are executed in {executed / rate:.2g} s, before the next look"
    remedy = f"Lower n_action_steps, and run it with --policy-hz {rate:g}."
    return [Finding.judged(PART, "rate", told, executed / rate > BLIND_SECONDS, remedy)]


def _range(one: Placed) -> Finding:
    """Numbers of one key, against those of the training data."""
    what, share = f"range of {one.key}", float(one.outside.mean())
    if exchanged := one.in_place_of():
        told = f"{told_outside(one)}; {', '.join(f'column {a} is as {b} was' for a, b in exchanged.items())}"
        remedy = "The columns look permuted: give them in the order of the training data, here and on the robot."
        return Finding(PART, what, told, Level.PROBLEM, remedy)
    filled = np.ptp(one.values, axis=0) * np.abs(one.seen.scale) / 2
    usual = float(np.median(filled[filled > 0])) if (filled > 0).any() else 1.0
    unit = "are they degrees, and were radians" if _DEGREES[0] < usual < _DEGREES[1] else "is it another unit"
    if share > one.some:
        remedy = f"Look: {unit}, or another zero of the joints? If not, the statistics are of another data set."
        return Finding(PART, what, told_outside(one), Level.PROBLEM if share > MOST else Level.WARNING, remedy)
    told = f"{share:.1%} of the numbers are outside of the training data's; they fill {usual:.0%} of its range"
    remedy = "Look: are they radians, and were degrees? If not, the statistics are of another data set."
    return Finding.judged(PART, what, told, usual < _LITTLE, remedy)


def _pictures(episodes: Sequence[Episode], spec: PolicySpec, means: Means) -> list[Finding]:
    """Cameras that show nothing, the same, or what another one showed."""
    found, seen = [], {}
    for key in [key for key, one in spec.observations.items() if one.image]:
        pictures = np.concatenate([each.observations[key] for each in episodes])
        seen[key] = pictures.reshape(-1, *pictures.shape[-3:]).mean((0, 2, 3), dtype=np.float64)
        told, remedy = f"mean {', '.join(f'{n:.2f}' for n in seen[key])}", "Is the camera on, and its lens free?"
        found.append(Finding.judged(PART, f"pictures of {key}", told, bool(np.ptp(pictures) < _APART), remedy))
    for a, b in itertools.combinations(seen, 2):
        told, remedy = "", "The cameras look exchanged: compare a picture of each with the training data."
        if all(np.array_equal(each.observations[a], each.observations[b]) for each in episodes):
            told, remedy = f"{a} and {b} are the same", "One camera has both names: look at the robot's configuration."
        elif {a, b} <= means.keys() and all(
            _as(seen[one], means[other], means[one]) for one, other in ((a, b), (b, a))
        ):
            told = f"{a} is as {b} was in training, and the other way round"
        if told:
            found.append(Finding(PART, "pictures", told, Level.WARNING, remedy))
    return found


def _as(mean: npt.NDArray[np.float64], other: npt.NDArray[np.float64], own: npt.NDArray[np.float64]) -> bool:
    """Whether a mean picture is clearly another camera's."""
    far, near = float(np.abs(mean - own).max()), float(np.abs(mean - other).max())
    return far > _APART and 2 * near < far
