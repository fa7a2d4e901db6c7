"""``ttscompile inspect``: what is in an artifact, and a picture of one of its plans."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
import numpy.typing as npt

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.cli.options import artifact_argument, json_option
from ttscompile.cli.output import print_json, progress, results, say
from ttscompile.cli.summary import print_summary
from ttscompile.cli.types import FILE, PICTURE, TEXT
from ttscompile.core.lattice import PlanArray
from ttscompile.errors import ArtifactError, ObservationError
from ttscompile.plots.maps import plot_plan
from ttscompile.report.summary import document
from ttscompile.runtimes.open import open_runtime
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.trajectories import read_npz

SCHEDULE = "schedule"
"""Name that calibration gives to its best plan that does not depend on the observation."""


@click.command()
@artifact_argument
@click.option("--plot", "picture", type=PICTURE, help="Draw a plan into this file (.png, .svg or .pdf).")
@click.option(
    "--plan", "name", type=TEXT, help="The plan to draw. Without this option it is the artifact's default plan."
)
@click.option(
    "--observation",
    type=FILE,
    help="An .npz file with an array for each key of the observation, of one call or of the calls of one episode. It is"
    " needed for plans that depend on the observation; the plan of its last call is drawn.",
)
@json_option
def inspect(directory: Path, picture: Path | None, name: str | None, observation: Path | None, as_json: bool) -> None:
    """Show what the artifact DIRECTORY holds: the policy, its blocks, what they cost, its plans and calibration."""
    if picture is None and (name is not None or observation is not None):
        raise click.UsageError("--plan and --observation choose what --plot draws; give --plot FILE too.")
    artifact = load_artifact(directory)
    if picture is not None:
        name = name or _drawn_by_default(artifact, observation)
        kinds = [block.kind for block in artifact.manifest.blocks]
        plot_plan(_plan(artifact, name, observation), kinds, picture, f"plan {name!r}")
        say(progress(), f"wrote {picture}")
    if as_json:
        print_json(document(artifact))
    else:
        print_summary(artifact, results())


def _drawn_by_default(artifact: Artifact, observation: Path | None) -> str:
    """The default plan; without an observation the best schedule in place of plans that depend on one."""
    default = artifact.manifest.default_plan
    record = artifact.manifest.plans.get(default)
    if record is None or record.kind != "pruner" or observation is not None or SCHEDULE not in artifact.plans:
        return default
    say(
        progress(),
        f"plan {default!r} is made for each observation, and none was given: drawing {SCHEDULE!r}, the schedule that"
        " it departs from",
    )
    return SCHEDULE


def _plan(artifact: Artifact, name: str, observation: Path | None) -> PlanArray:
    """The plan to draw, int8 ``[K, blocks]``."""
    if (cells := artifact.plan(name).cells) is not None:
        return cells
    if observation is None:
        others = [each for each, one in artifact.plans.items() if not one.pruned]
        raise ArtifactError(
            f"{artifact.path}: plan {name!r} is made for each observation, and none was given. Add --observation"
            f" FILE.npz, or draw a schedule with --plan: {', '.join(others)}."
        )
    policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)  # of this artifact, whatever is there by now
    for call in _calls(observation, artifact):
        policy.predict_action(call, plan=name)
    report = policy.last_report
    assert report is not None  # there is at least one call
    plan: PlanArray = report.plan[0]
    return plan


def _calls(path: Path, artifact: Artifact) -> list[dict[str, npt.NDArray[np.generic]]]:
    """The observations of consecutive calls, ``[1, ...]`` an array; the policy checks all but their number."""
    specs = artifact.manifest.spec.observations
    stored = read_npz(path)
    if missing := [key for key in specs if key not in stored]:
        raise ObservationError(f"{path}: has no array {missing[0]!r}; expected {list(specs)}, found {list(stored)}.")
    rows = {k: stored[k] if stored[k].ndim > len(spec.shape) else stored[k][None] for k, spec in specs.items()}
    counts = {k: len(a) for k, a in rows.items()}
    if len(set(counts.values())) != 1 or 0 in counts.values():
        raise ObservationError(f"{path}: expected as many calls for every key, at least one; found {counts}.")
    return [{k: a[i : i + 1] for k, a in rows.items()} for i in range(min(counts.values()))]
