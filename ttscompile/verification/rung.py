"""What a rung of the ladder found, and all of them together."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

PASSED, FAILED, SKIPPED = "passed", "failed", "skipped"


@dataclass(frozen=True)
class Rung:
    """One check.

    Attributes:
        status: ``passed``, ``failed`` or ``skipped``.
        told: what was compared, and what was found.
        figure: the error; None where there is no number.
        tolerance: the largest error that passes.
        unit: what error and tolerance are shares or multiples of.
        remedy: what to do; empty if nothing is to be done.
        step: first denoising step that differs; None if none does, or none can be named.
        blocks: residual blocks that differ.
    """

    name: str
    status: str
    told: str
    figure: float | None = None
    tolerance: float | None = None
    unit: str = ""
    remedy: str = ""
    step: int | None = None
    blocks: tuple[int, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def place(self) -> str:
        """Where it first differs, for people: ``step 3, blocks 0, 2``; empty if nowhere."""
        parts = [f"step {self.step}"] if self.step is not None else []
        if self.blocks:
            shown = ", ".join(map(str, self.blocks[:8])) + ", .." * (len(self.blocks) > 8)
            parts.append(f"block{'s' * (len(self.blocks) > 1)} {shown}")
        return ", ".join(parts)


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Errors by denoising step and residual block.

    Attributes:
        steps: the steps that were looked at, ``[A]``.
        errors: relative error of each block's residual there, ``[A, blocks]``.
        plan: name of a plan of which cells differ from what was calibrated; None if none does.
        cells: bool ``[K, blocks]``, true for these cells; None if none differs.
    """

    steps: npt.NDArray[np.int64]
    errors: npt.NDArray[np.float64]
    tolerance: float
    kinds: tuple[str, ...]
    plan: str | None = None
    cells: npt.NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class Verification:
    """The ladder from bottom to top.

    Attributes:
        path: of the artifact, as it was given.
        identity: sha256 of what the artifact computes; None where that cannot be read.
        model_identity: the same without plans.
        rungs: in order; after one of integrity that failed there are none.
        seconds: how long all rungs took.
        map: errors of residuals; None if they were not looked at.
    """

    path: str
    identity: str | None
    model_identity: str | None
    rungs: tuple[Rung, ...]
    seconds: float
    map: ErrorMap | None = None

    @property
    def failed(self) -> list[Rung]:
        """The rungs that failed, from the lowest: those above it stand on it."""
        return [rung for rung in self.rungs if rung.status == FAILED]

    @property
    def passed(self) -> bool:
        """Whether no rung failed."""
        return not self.failed

    @property
    def first_failure(self) -> Rung | None:
        """The lowest rung that failed."""
        return next(iter(self.failed), None)

    @property
    def skipped(self) -> list[Rung]:
        """The rungs that could not be tried."""
        return [rung for rung in self.rungs if rung.status == SKIPPED]

    def rung(self, name: str) -> Rung:
        """The rung of this name."""
        return next(rung for rung in self.rungs if rung.name == name)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        failure, map_ = self.first_failure, None
        if self.map is not None:
            errors = [[finite(error) for error in row] for row in self.map.errors.tolist()]
            map_ = {"steps": self.map.steps.tolist(), "errors": errors, "tolerance": self.map.tolerance}
        return {
            "path": self.path,
            "identity": self.identity,
            "model_identity": self.model_identity,
            "passed": self.passed,
            "first_failure": None if failure is None else failure.name,
            "seconds": round(self.seconds, 3),
            "rungs": [{**asdict(rung), "blocks": list(rung.blocks)} for rung in self.rungs],
            "map": map_,
        }


def finite(number: float) -> float | None:
    """For JSON, which has no NaN and no infinity."""
    return number if np.isfinite(number) else None


def judged(name: str, error: float, tolerance: float, unit: str, told: str, remedy: str, **more: Any) -> Rung:
    """A rung that passes where its error keeps within the tolerance; otherwise there is something to do."""
    if error <= tolerance:
        return Rung(name, PASSED, told, error, tolerance, unit, **more)
    return Rung(name, FAILED, told, finite(error), tolerance, unit, remedy, **more)
