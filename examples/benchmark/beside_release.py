"""An artifact of another ttscompile beside one of this version, of the same checkpoint: the same actions, as fast?

    git worktree add ../before COMMIT; python -m venv ../before/.venv
    ../before/.venv/bin/pip install ../before -c ../before/constraints.txt
    ../before/.venv/bin/ttscompile convert policy.ckpt -o before/; ttscompile convert policy.ckpt -o now/
    ../before/.venv/bin/ttscompile calibrate before/ --trajectories calls.npz --max-minutes 1
    python examples/benchmark/beside_release.py ../before/.venv/bin/python before/ now/

The default plan of the other artifact is put into a copy of this one: its cells, and its correction. Each version loads
its own in a process of its own. The two answer the same random observations, with the same seed, and take turns. Times
are those of the processor, on one thread; a load has the imports of ttscompile in it.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.table import Table
from safetensors.numpy import load_file

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.correction import Correction
from ttscompile.core.plan import DENSE, FULL
from ttscompile.runtimes.random_calls import random_calls

SCHEDULE = "schedule"
LOADS, CALLS = 5, 24
TURN_MS = 500
"""What a turn takes at most, about: 24 calls, or fewer."""


@dataclass(frozen=True)
class Row:
    """One plan in both versions.

    Attributes:
        plan: ``dense`` or ``schedule``.
        difference: largest of the actions, in their units; 0.0 where each bit is the same.
        other_ms: of a call of the other version; the median.
        ms: of this one.
        ratio: median of rounds in which the two take turns, and the limits of the middle 80 %.
        mib: memory that no file backs, after these calls: of the other version, and of this one.
    """

    plan: str
    difference: float
    other_ms: float
    ms: float
    ratio: tuple[float, float, float]
    mib: tuple[float, float]


class Side:
    """A version in a process of its own."""

    def __init__(self, python: str, artifact: Path, observations: Path) -> None:
        side = Path(__file__).with_name("release_side.py")
        self._process = subprocess.Popen(
            [python, str(side), str(artifact), str(observations)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self.loaded = self._answer()

    def ask(self, **asked: Any) -> dict[str, Any]:
        """What it answers."""
        assert self._process.stdin is not None
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise click.ClickException("a version ended with the error above.")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def manifest_of(artifact: Path) -> dict[str, Any]:
    """As it stands in the file: this version does not read that of each other one."""
    manifest: dict[str, Any] = json.loads((artifact / "manifest.json").read_text())
    return manifest


def with_plan_of(other: Path, artifact: Path, into: Path) -> None:
    """Copy an artifact, with the default plan of another one's as its own, executed by its loop of as many steps.

    Raises:
        click.ClickException: the other one was not calibrated.
    """
    name = manifest_of(other)["default_plan"]
    arrays = {key: array for stored in other.glob("plans-*.safetensors") for key, array in load_file(stored).items()}
    if name not in arrays:
        raise click.ClickException(f"{other}: its default plan is {name!r}. Calibrate it first.")
    parts: dict[str, Any] = {
        key.rpartition("/")[2]: arrays[key] for key in arrays if key.startswith(f"correction/{name}/")
    }
    shutil.copytree(artifact, into)
    plans = load_artifact(into).plans
    correction = Correction(**parts) if parts else None
    plan = replace(plans.get(FULL, plans[DENSE]), cells=arrays[name], correction=correction, repair=True)
    update_plans(into, {**plans, SCHEDULE: plan}, SCHEDULE)


def beside(python: str, other: Path, artifact: Path, rounds: int) -> tuple[list[Row], dict[str, list[float]]]:
    """Both plans in both versions, and by side the median seconds and MiB of a load."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with_plan_of(other, artifact, folder / "now")
        loaded = load_artifact(folder / "now")
        given = [obs for obs, _ in random_calls(loaded.manifest.spec, CALLS, seed=0)]
        calls: dict[str, Any] = {key: np.concatenate([obs[key] for obs in given]) for key in given[0]}
        np.savez(folder / "calls.npz", **calls)
        # What computes all of the loop. In 0.1.0 it was called dense, whatever the loop.
        full = tuple(FULL if FULL in manifest_of(one)["plans"] else DENSE for one in (other, artifact))
        opened = [(python, other), (sys.executable, folder / "now")]
        loads: list[list[list[float]]] = [[], []]
        for _ in range(LOADS):
            for number, (with_python, path) in enumerate(opened):
                side = Side(with_python, path, folder / "calls.npz")
                side.close()
                loads[number].append([side.loaded["seconds"], side.loaded["mib"]])
        sides = [Side(with_python, path, folder / "calls.npz") for with_python, path in opened]
        rows = [
            compared(sides, full, DENSE, rounds, folder),
            compared(sides, (SCHEDULE, SCHEDULE), SCHEDULE, rounds, folder),
        ]
        for side in sides:
            side.close()
    took = {name: np.median(own, axis=0).tolist() for name, own in zip(("before", "now"), loads, strict=True)}
    return rows, took


def compared(sides: Sequence[Side], names: Sequence[str], plan: str, rounds: int, folder: Path) -> Row:
    """One plan, by its name on each side."""
    actions = []
    for number, (side, name) in enumerate(zip(sides, names, strict=True)):
        side.ask(plan=name, into=str(folder / f"{number}.npy"))
        actions.append(np.load(folder / f"{number}.npy"))
        once = side.ask(plan=name, calls=3)["ms"]
    calls = max(1, min(CALLS, round(TURN_MS / once)))
    ms: list[tuple[float, ...]] = []
    for number in range(rounds):
        turn = (0, 1) if number % 2 else (1, 0)
        took = {one: sides[one].ask(plan=names[one], calls=calls)["ms"] for one in turn}
        ms.append((took[0], took[1]))
    mib = [side.ask(plan=name, calls=1)["mib"] for side, name in zip(sides, names, strict=True)]
    low, middle, high = np.quantile([now / before for before, now in ms], [0.1, 0.5, 0.9])
    before, now = np.median(ms, axis=0)
    difference = 0.0 if actions[0].tobytes() == actions[1].tobytes() else float(np.abs(actions[0] - actions[1]).max())
    return Row(plan, difference, float(before), float(now), (float(middle), float(low), float(high)), (mib[0], mib[1]))


@click.command(help=__doc__)
@click.argument("python")
@click.argument("other", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--rounds", default=30, show_default=True, type=click.IntRange(1), help="Turns of up to 24 calls each.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document in place of the table.")
def main(python: str, other: Path, directory: Path, rounds: int, as_json: bool) -> None:
    rows, loads = beside(python, other, directory, rounds)
    if as_json:
        print(json.dumps({"rows": [asdict(row) for row in rows], "loads": loads}))
        return
    table = Table(
        "plan", "actions differ by", "ms before", "ms now", "now / before [80 % of turns]", "MiB before", "now"
    )
    for row in rows:
        middle, low, high = row.ratio
        differ = "no bit" if row.difference == 0 else f"{row.difference:.2g}"
        times = f"{row.other_ms:.2f}", f"{row.ms:.2f}", f"{middle:.2f} [{low:.2f}, {high:.2f}]"
        table.add_row(row.plan, differ, *times, *(f"{mib:.0f}" for mib in row.mib))
    console = Console()
    console.print(table)
    for name, (seconds, mib) in loads.items():
        console.print(f"{name}: {seconds:.2f} s of the processor to import and load, then {mib:.0f} MiB")


if __name__ == "__main__":
    main()
