"""What ``ttscompile verify`` found, as a section of a report."""

from __future__ import annotations

from ..plots.errors import plot_errors
from ..verification import Rung, Verification
from .page import Picture, Section, Table
from .pictures import drawn, plain

NOT_RUN = Section("Verification", ("Not run for this report: --verify adds it, ttscompile verify DIR runs it alone.",))


def refused(reason: str) -> Section:
    """The section of an artifact that cannot be verified."""
    return Section("Verification", (f"Could not be run: {reason}",))


def verified(found: Verification) -> Section:
    """A row a rung, what to do about the first that failed, and where residuals differ."""
    rows = tuple(
        (rung.name, rung.status, _number(rung.figure), _number(rung.tolerance), rung.unit, _told(rung))
        for rung in found.rungs
    )
    failure = found.first_failure
    text = (
        f"All rungs hold; {found.seconds:.1f} s. Neither the checkpoint nor torch was needed."
        if failure is None
        else f"FAILED at {failure.name}. {failure.remedy} What fails above it may only follow from it."
    )
    return Section(
        "Verification",
        (text,),
        (Table(("rung", "verdict", "error", "allowed", "of what", "found"), rows),),
        _map(found),
    )


def _map(found: Verification) -> tuple[Picture, ...]:
    errors = found.map
    if errors is None:
        return ()
    kinds = [plain(kind) for kind in errors.kinds]
    png = drawn(
        lambda path: plot_errors(
            errors.errors, errors.steps.tolist(), kinds, errors.tolerance, path, "residuals", errors.cells, None
        )
    )
    caption = "Relative error of every block's residual at the steps that were looked at: steps across, blocks down."
    return (Picture(png, alt=caption, caption=caption),)


def _told(rung: Rung) -> str:
    return f"{rung.told}." + (f" First at {rung.place}." if rung.place else "")


def _number(figure: float | None) -> str:
    return "" if figure is None else f"{figure:.2g}"
