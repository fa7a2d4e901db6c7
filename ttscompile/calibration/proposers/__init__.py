"""What learns, a row each; a module here has what its row names. What there is can be listed without torch."""

import pkgutil

from ...core.plan import SCHEDULE
from ...errors import CalibrationError
from ..proposer import Row, ScheduleRow

RIVALS: tuple[ScheduleRow, ...] = pkgutil.resolve_name("ttscompile.rivals:RIVALS")

SCHEDULES: tuple[ScheduleRow, ...] = (
    ScheduleRow(SCHEDULE, "which steps are computed, with corrections and jumps", "calibration.tts:Tts", corrects=True),
    *RIVALS,
)
"""Proposers of schedules: this project's own, and those that it is compared with."""

LOOPS = "loops"
"""The proposer after which the default is chosen among all plans that were kept (``choose``)."""

PROPOSERS: tuple[Row, ...] = (
    *SCHEDULES,
    Row(
        LOOPS,
        "which loop, and how few of its steps; the default is chosen at the end",
        "calibration.proposers.loops:Loops",
        corrects=True,
        anew=True,
        takes=6.0,
    ),
    Row("pruner", "gates for each observation", "calibration.proposers.pruner:Pruner", consecutive=True),
    Row(
        "precision",
        "which parts compute in the other precision",
        "calibration.proposers.precision:Precision",
        lowers=True,
    ),
    Row("tokens", "when a token of an encoder or of the scene is computed anew", "calibration.proposers.tokens:Tokens"),
    Row(
        "weights",
        "low-rank updates of later steps' weights",
        "calibration.proposers.weights:Weights",
        corrects=True,
        trains=True,
    ),
    Row("start", "how many steps a call needs that begins with the chunk before", "calibration.proposers.start:Start"),
)
"""In the order in which they propose, whatever the order in which they are asked for."""


def rows_of(learn: tuple[str, ...]) -> tuple[Row, ...]:
    """The rows of these names, in the order of ``PROPOSERS``; at most one of them begins anew."""
    names = [row.name for row in PROPOSERS]
    unknown = [name for name in learn if name not in names]
    if unknown or not learn:
        found = repr(unknown[0]) if unknown else "none"
        raise CalibrationError(f"learn: expected some of {', '.join(names)}; found {found}.")
    rows = tuple(row for row in PROPOSERS if row.name in learn)
    if len(anew := [repr(row.name) for row in rows if row.anew]) > 1:
        raise CalibrationError(
            f"learn: expected one that makes the first plan; found {' and '.join(anew)}. Take one of them."
        )
    return rows
