"""Whether recordings fit a policy: names, pictures, ranges and rate; for the doctor, and for who learns from them."""

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..core.finding import Finding, Level
from ..core.spec import Affine, PolicySpec
from ..core.tokenizer import TASK, ReadTokenizer
from ..errors import TrajectoryError
from .episodes import Episode, array_names, default_sources, episodes_of, local_path, recorded_names
from .frames import few
from .rate import rate_of

PART = "recordings"

REACH = 1.05
"""Normalised numbers are outside beyond this, either way: recordings may stray a little from the training data."""

SOME, USUAL, MOST = 0.02, 0.1, 0.5
"""Shares of a key's numbers outside that are worth a warning, of a normaliser and of statistics, and an error. Of
numbers whose mean is 0 and deviation 1, which another kind of normaliser makes, a third are outside; with a unit or an
order of their own nearly all are."""

LITTLE = 0.05
"""Share of the range of the training data: who fills less gives another unit, radians for degrees, say."""


@dataclass(frozen=True)
class Placed:
    """Recorded numbers ``[N, D]`` of a key, what maps the training data's range to -1..1, and the share to warn at."""

    key: str
    values: npt.NDArray[np.float32]
    seen: Affine
    some: float

    @property
    def outside(self) -> npt.NDArray[np.bool_]:
        """``[N, D]``: which of them lie outside of the range."""
        return np.abs(self.seen.normalize(self.values)) > REACH

    def in_place_of(self) -> dict[int, int]:
        """Columns that lie outside of their own range, by another such column whose range they lie in; all, or none."""
        wrong, found = np.flatnonzero(self.outside.mean(0) > MOST), dict[int, int]()
        for column in wrong.tolist():
            moved = self.values[:, [column]] * self.seen.scale[wrong] + self.seen.offset[wrong]
            fits = wrong[(np.abs(moved) > REACH).mean(0) <= SOME].tolist()
            if not (free := [n for n in fits if n not in found.values()]):
                return {}
            found[column] = free[0]
        return found


def placed(episodes: Sequence[Episode], spec: PolicySpec) -> Iterator[Placed]:
    """The recorded numbers of every key of which it is known where those of the training data were.

    A normaliser inside of the network tells that by its statistics. Where one is by mean and deviation they do not end
    there; whether it is one is known of the actions alone, whose kind observations mostly share.
    """
    for key, one in spec.observations.items():
        if np.dtype(one.dtype).kind != "f" or one.image or (one.normalizer is None and one.bounds is None):
            continue
        seen, some = one.normalizer, SOME
        if seen is None and one.bounds is not None:
            low, high = (np.broadcast_to(np.asarray(end, np.float32), one.shape[-1:]) for end in one.bounds)
            width = np.maximum(high - low, 1e-3 * np.maximum(np.abs(low), 1e-3))
            seen, some = Affine(2 / width, -(low + high) / width), USUAL
        assert seen is not None
        values = np.concatenate([each.observations[key] for each in episodes]).reshape(-1, one.shape[-1])
        yield Placed(key, values, seen, some if spec.chunk.ranged else MOST)


def judged(one: Placed) -> Finding:
    """The numbers of one key, against those of the training data."""
    outside, share = one.outside, float(one.outside.mean())
    filled = np.ptp(one.values, axis=0) * np.abs(one.seen.scale) / 2
    usual = float(np.median(filled[filled > 0])) if filled.any() else 1.0
    level = Level.PROBLEM if share > MOST else Level.WARNING if share > one.some or usual < LITTLE else Level.OK
    worst = np.argsort(-outside.mean(0), kind="stable")[: int(outside.any(0).sum())].tolist()
    columns = ", ".join(f"{n} ({outside[:, n].mean():.0%})" for n in worst[:5])
    columns += f" and {len(worst) - 5} more" * (len(worst) > 5)
    beyond = "outside of what the policy's normaliser maps to -1..1"
    told = (
        f"{outside.sum()} of {outside.size} recorded numbers ({share:.0%}) lie {beyond}, by up to"
        f" {np.abs(one.seen.normalize(one.values)).max():.3g} times; columns {columns}"
    )
    remedy = "Look at their unit (degrees, radians), the order of the columns, and --observation. If these are right,"
    remedy += " the statistics are of another data set, and what the policy answers means nothing."
    if exchanged := one.in_place_of():
        told += "; " + ", ".join(f"column {a} is as {b} was" for a, b in exchanged.items())
        level, remedy = Level.PROBLEM, "The columns look permuted: give them in the order of the training data."
    elif share <= one.some:
        told = f"{share:.1%} of the numbers lie {beyond}; half of the columns fill {usual:.0%} of that, or more"
    return Finding(PART, f"range of {one.key!r}", told, level, "" if level is Level.OK else remedy)


def check_ranges(episodes: Sequence[Episode], spec: PolicySpec) -> None:
    """Warn of recorded numbers outside of what the normaliser maps to -1..1; refuse most, and permuted columns.

    Raises:
        TrajectoryError: most are outside, or columns are permuted; says how many there are, and in which columns.
    """
    for one in placed(episodes, spec):
        found = judged(one)
        if found.level is Level.PROBLEM:
            raise TrajectoryError(f"observation: {found.told}")
        if float(one.outside.mean()) > one.some:
            warnings.warn(f"observation: {found.told}", stacklevel=2)


_LANGUAGE = "observation.language."
"""Begins the keys of an instruction's tokens, as lerobot names them."""

_BLIND_SECONDS = 3.0
"""For which a chunk is executed without looking, from which on a robot misses what happens."""


def examine_recordings(
    paths: Sequence[str | os.PathLike[str]],
    spec: PolicySpec,
    sources: Mapping[str, Sequence[str]],
    tokenizer: ReadTokenizer | None = None,
) -> list[Finding]:
    """Look at recordings, which are given as to ``load_trajectories``, as the policy would observe them."""
    found, renamed = list[Finding](), dict(sources)
    language = [key for key in spec.observations if key.startswith(_LANGUAGE)]
    if tokenizer is None and (said := [key for key in language if not {key, TASK} & set(sources)]):
        observed = {key: one for key, one in spec.observations.items() if key not in said}
        spec = replace(spec, observations=observed, instruction=None)
        made = "an artifact with its tokenizer makes them of recorded instructions, and convert --task compiles one in"
        told = f"{', '.join(said)}: not looked at; {made}"
        found.append(Finding(PART, "instruction", told, Level.NOTE))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            for path in map(local_path, paths):
                found += [*_names(path, spec, renamed, tokenizer is not None), *_rate(path, spec)]
            episodes = episodes_of(spec, paths, renamed, tokenizer)
        except TrajectoryError as error:
            return [*found, Finding(PART, "load", str(error), Level.PROBLEM, "As it says; nothing else was tried.")]
    found += [Finding(PART, "load", told, Level.NOTE) for told in dict.fromkeys(str(each.message) for each in warned)]
    alone, told = len(episodes) < 2, f"{sum(each.calls for each in episodes)} in {len(episodes)} episodes"
    remedy = "'calibrate' needs two: plans are judged on others than those that it learns from. Record sixteen."
    found.append(Finding.judged(PART, "calls", told, alone, remedy, Level.PROBLEM))
    return [*found, *map(judged, placed(episodes, spec))]


def _names(path: Path, spec: PolicySpec, renamed: dict[str, Sequence[str]], reads_text: bool) -> list[Finding]:
    """Keys that a recording lacks; a name that may stand for one is added to ``renamed``, and said."""
    names, frames = recorded_names(path)
    made = default_sources(spec.observations, names, frames) | renamed
    used = array_names(spec.observations, made)
    worded = TASK in renamed or (reads_text and TASK in names)
    text = {spec.instruction.tokens, spec.instruction.mask} if worded and spec.instruction else set[str]()
    missing = [key for key in spec.observations if key not in made and key not in names and key not in text]
    free = [name for name in names if name not in used]
    if not missing:
        return [Finding(PART, path.name, "what the policy observes" + f"; not read: {few(free)}" * bool(free))]
    pairs = _pairs(missing, free)
    remedy = "Record what the policy observes, or convert it without that camera (--without-camera)."
    if pairs and frames:
        renamed |= {key: (name,) for key, name in pairs.items()}
        words = " ".join(f"--observation {key}={name}" for key, name in pairs.items())
        remedy = f"If these are the same, say so: {words}. With lerobot it is rename_map. The rest was tried so."
    elif pairs:
        remedy = f"If these are the same, save {', '.join(f'{name} as {key}' for key, name in pairs.items())}."
    return [Finding(PART, path.name, f"lacks {', '.join(missing)}; it has {few(names)}", Level.PROBLEM, remedy)]


def _pairs(missing: Sequence[str], free: Sequence[str]) -> dict[str, str]:
    """By key the name of the same group that may stand for it: the one most like it, or the last for the last."""
    found: dict[str, str] = {}
    for key in (*missing, *missing):  # what is left the second time
        group, _, last = key.rpartition(".")
        left = {name.rpartition(".")[2]: name for name in free if name not in found.values() and name.startswith(group)}
        like = [each for each in left if last in each or each in last] or get_close_matches(last, left, 1)
        others = [each for each in missing if each.startswith(group) and each not in (key, *found)]
        if key not in found and len(like := like or list(left) * (not others)) == 1:
            found[key] = left[like[0]]
    return found


def _rate(path: Path, spec: PolicySpec) -> list[Finding]:
    if (rate := rate_of(path)) is None:
        return []
    executed = spec.chunk.executes
    told = f"{rate:g} Hz: {executed} steps are executed in {executed / rate:.2g} s, before the next look"
    return [Finding.judged(PART, "rate", told, executed / rate > _BLIND_SECONDS, "Lower n_action_steps.")]
