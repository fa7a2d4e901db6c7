"""``ttscompile bench --choose``: which plan is the default on this machine, by the rule of ``build``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ttscompile.artifact.ceiling import BOUND, FARTHEST
from ttscompile.artifact.default_plan import choose_default
from ttscompile.artifact.load import Artifact
from ttscompile.calibration.proposer import near
from ttscompile.core.plan import DENSE, UNIFORM
from ttscompile.core.spec import FP32
from ttscompile.errors import ArtifactError
from ttscompile.measure.machine import fingerprint
from ttscompile.measure.points import best_plan
from ttscompile.measure.timer import Times
from ttscompile.measure.units import ms
from ttscompile.report.facts import scores
from ttscompile.report.timing import Measurement

IN_FP32 = f"@{FP32}"


def choosable(artifact: Artifact, bound: float = FARTHEST) -> dict[str, float]:
    """How far plans are from the original that were judged to be within a bound, by name.

    Plans of fewer bits are among them in fp32, too, in which they are no further away.

    Raises:
        ArtifactError: none is within ``FARTHEST``.
    """
    found: dict[str, float] = {}
    for name, score in scores(artifact.manifest.calibration, ("distance", "interval")).items():
        within = name in artifact.plans and near(score["distance"], score["interval"], bound)
        if within and name not in (DENSE, UNIFORM):
            found[name] = score["distance"]
            if artifact.plans[name].precision and artifact.plans[name].tokens is None:
                found[name + IN_FP32] = score["distance"]
    if bound == FARTHEST and not found:
        problem = f"{artifact.path}: there is nothing to choose among: no plan was judged to be within {FARTHEST:g}"
        raise ArtifactError(f"{problem}. Run 'ttscompile build', or 'ttscompile calibrate', first.")
    return found


def choose_again(
    directory: Path, artifact: Artifact, measured: Sequence[Measurement], deadline_ms: float | None, threads: int
) -> str | None:
    """Make the plan the default that the rule of ``build`` chooses by these times, and keep them in the record.

    Args:
        measured: of plans that are ``choosable``, and of others, on this machine.
        deadline_ms: that the longest call may take; None for that of the build, if it had one.
        threads: that these calls had.

    Returns:
        What was chosen, for people; None where no plan keeps the deadline, and nothing was changed.
    """
    record, far, close = dict(artifact.manifest.calibration or {}), choosable(artifact), choosable(artifact, BOUND)
    deadline = record.get("budget", {}).get("latency_ms") if deadline_ms is None else deadline_ms
    times: dict[str, Times] = {}
    for one in measured:
        if one.plan in far:  # of another artifact, or with more threads, it is timed later
            times.setdefault(one.plan, Times(one.times_ms))
    chosen = best_plan(times, far, close.keys() & times.keys(), deadline)
    if chosen is None:
        return None
    name, before = chosen.removesuffix(IN_FP32), artifact.manifest.default_plan
    told = ", ".join(f"{each} {ms(one.median)} ms" for each, one in times.items())
    here = f"{fingerprint()['processor']}, {threads} thread{'s' * (threads > 1)}: {told}"
    record |= {"default_plan": name, "chosen_on": here}
    precision: dict[str, str] | None = None
    if chosen != name:
        precision, words = {}, replace(artifact.plans[name], precision={}).in_words()
        tried = record.get("frontier", ())
        record["frontier"] = [{**row, "told": words} if row["name"] == name else row for row in tried]
    choose_default(directory, name, record, precision, artifact)
    changed = "is" if name == before else f"was {before!r}, and is"
    return f"The default {changed} {name!r}{', in fp32' * (chosen != name)}. {told}."
