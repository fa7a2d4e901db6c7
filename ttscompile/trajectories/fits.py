"""Whether recordings fit a policy: names, pictures, ranges and rate; for the doctor."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path

from ..core.finding import Finding, Level
from ..core.spec import PolicySpec
from ..core.tokenizer import TASK
from ..core.untrusted_json import parse_json
from ..errors import TrajectoryError
from .episodes import load_trajectories, recorded_names
from .frames import few, one_error
from .lerobot_dataset import MAX_INFO
from .ranges import judged, placed

PART = "recordings"

_LANGUAGE = "observation.language."
"""Begins the keys of an instruction's tokens, as lerobot names them."""

_BLIND_SECONDS = 3.0
"""For which a chunk is executed without looking, from which on a robot misses what happens."""


def examine_recordings(paths: Sequence[Path], spec: PolicySpec, sources: Mapping[str, Sequence[str]]) -> list[Finding]:
    """Look at recordings, which are given as to ``load_trajectories``, as the policy would observe them."""
    found, renamed = list[Finding](), dict(sources)
    if said := [key for key in spec.observations if key.startswith(_LANGUAGE) and not {key, TASK} & set(sources)]:
        observed = {key: one for key, one in spec.observations.items() if key not in said}
        spec = replace(spec, observations=observed, instruction=None)
        told = f"{', '.join(said)}: not looked at; recordings seldom have them, and convert --task compiles a text in"
        found.append(Finding(PART, "instruction", told, Level.NOTE))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            for path in paths:
                found += [*_names(path, spec, renamed), *_rate(path, spec)]
            steps = spec.chunk.stop - spec.chunk.start
            episodes = load_trajectories(paths, spec.observations, steps, renamed, spec.instruction)
        except TrajectoryError as error:
            return [*found, Finding(PART, "load", str(error), Level.PROBLEM, "As it says; nothing else was tried.")]
    found += [Finding(PART, "load", str(each.message), Level.NOTE) for each in warned]
    found.append(Finding(PART, "calls", f"{sum(each.calls for each in episodes)} in {len(episodes)} episodes"))
    return [*found, *map(judged, placed(episodes, spec))]


def _names(path: Path, spec: PolicySpec, renamed: dict[str, Sequence[str]]) -> list[Finding]:
    """Keys that a recording lacks; a name that may stand for one is added to ``renamed``, and said."""
    names, frames = recorded_names(path)
    used = {part.partition(":")[0] for key in spec.observations for part in renamed.get(key, (key,))}
    text = {spec.instruction.tokens, spec.instruction.mask} if TASK in renamed and spec.instruction else set[str]()
    missing = [key for key in spec.observations if key not in renamed and key not in names and key not in text]
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
    info, executed = path / "meta" / "info.json", spec.chunk.stop - spec.chunk.start
    if not info.is_file():
        return []
    with one_error(f"{path}: meta/info.json cannot be read"):
        rate = float(parse_json(info.read_bytes(), MAX_INFO)["fps"])
        told = f"{rate:g} Hz: {executed} steps are executed in {executed / rate:.2g} s, before the next look"
    remedy = f"Lower n_action_steps, and run it with --policy-hz {rate:g}."
    return [Finding.judged(PART, "rate", told, executed / rate > _BLIND_SECONDS, remedy)]
