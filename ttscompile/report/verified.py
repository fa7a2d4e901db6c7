"""What ``ttscompile verify`` found, as a section of the page."""

from __future__ import annotations

from ..plots.figure import encoded
from ..plots.maps import plot_errors
from ..verification import Rung, Verification
from .page import Picture, Section, Table
from .pictures import plain

NOT_RUN = Section("Verification", ("Not run for this page: --verify adds it, ttscompile verify DIR runs it alone.",))


def verified(found: Verification) -> Section:
    """A row a rung, what to do about the first that failed, and where residuals differ."""
    rows = tuple((r.name, r.status, figure(r.figure), figure(r.tolerance), r.unit, _told(r)) for r in found.rungs)
    head = ("rung", "verdict", "error", "allowed", "of what", "found")
    text = f"All rungs hold; {found.seconds:.1f} s. Neither the checkpoint nor torch was needed."
    if (failure := found.first_failure) is not None:
        text = f"FAILED at {failure.name}. {failure.remedy} What fails above it may only follow from it."
    shown: tuple[Picture, ...] = ()
    if (errors := found.map) is not None:
        of = errors.errors, errors.steps.tolist(), [plain(kind) for kind in errors.kinds], errors.tolerance
        png = encoded(plot_errors(*of, "residuals", errors.cells))
        caption = (
            "Relative error of every block's residual at the steps that were looked at: steps across, blocks down."
        )
        shown = (Picture(png, caption),)
    return Section("Verification", (text,), (Table(head, rows),), shown)


def _told(rung: Rung) -> str:
    return f"{rung.told}." + (f" First at {rung.place}." if rung.place else "")


def figure(number: float | None) -> str:
    """An error or a tolerance for people; empty if there is none."""
    return "" if number is None else f"{number:.2g}"
