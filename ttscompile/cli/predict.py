"""``ttscompile predict``: the chunk of actions that an artifact answers to one observation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from ttscompile.artifact.load import load_artifact
from ttscompile.cli.observed import observed
from ttscompile.cli.options import artifact_argument, json_option, seed_option
from ttscompile.cli.output import print_identity, print_json, progress, results, say
from ttscompile.cli.types import FILE, PATH, PICTURE, TEXT
from ttscompile.errors import ObservationError
from ttscompile.plots.chunk import plot_chunk
from ttscompile.plots.figure import write_picture
from ttscompile.runtimes.load import open_policy


def _pictures(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for value in values:
        name, equals, path = value.partition("=")
        if not (equals and name and path) or name in found:
            raise click.BadParameter(f"{value!r}: expected NAME=FILE, each name once, for instance front=front.png.")
        found[name] = FILE.convert(path, None, None)
    return found


def _numbers(_: click.Context, __: click.Parameter, value: str | None) -> Any:
    try:
        return None if value is None else np.array([float(part) for part in value.split(",")])
    except ValueError as error:
        raise click.BadParameter(f"{value!r:.100}: expected numbers with commas between, as in 0.1,-2.") from error


@click.command()
@artifact_argument
@click.option(
    "--image",
    "pictures",
    type=TEXT,
    multiple=True,
    callback=_pictures,
    metavar="NAME=FILE",
    help="Show this picture (PNG or JPEG) to the camera NAME: its key, or the end of it, front for"
    " observation.images.front. May be repeated.",
)
@click.option("--state", type=TEXT, callback=_numbers, metavar="NUMBER,..", help="Give the state these numbers.")
@click.option("--task", type=TEXT, help="Give this instruction to a policy that reads one; needs --tokenizer.")
@click.option("--tokenizer", type=PATH, help="Read the task with this tokenizer.json, or that of this folder.")
@click.option(
    "--observation", "archive", type=FILE, help="Take arrays by key from this .npz: whatever the policy reads."
)
@click.option("--plan", type=TEXT, help="Compute this plan. Without this option it is the default plan.")
@click.option("--plot", "picture", type=PICTURE, help="Draw the chunk into this file (.png, .svg or .pdf).")
@seed_option("Seed of the noise that the actions are made of.")
@json_option
def predict(
    directory: Path,
    pictures: dict[str, Path],
    state: Any,
    task: str | None,
    tokenizer: Path | None,
    archive: Path | None,
    plan: str | None,
    picture: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Print the chunk of actions that the artifact DIRECTORY answers to one observation, in the robot's units.

    An observation is what the robot measures, not normalised. Where the policy reads several frames, one stands for
    all of them. It is the first call of an episode.
    """
    artifact = load_artifact(directory)
    spec = artifact.manifest.spec
    obs, repeated = observed(spec.observations, pictures, state, archive)
    if task is not None and (spec.instruction is None or tokenizer is None):
        compiled = f"the policy reads no text; compiled in is {spec.source.get('task', 'none')!r:.100}"
        told = compiled if spec.instruction is None else "--tokenizer PATH is needed, too"
        raise ObservationError(f"{directory}: --task {task!r:.100}: {told}. Or give tokens in --observation FILE.npz.")
    with progress().status("loading"):
        policy = open_policy(artifact, seed=seed, plan=plan, tokenizer=tokenizer)
    chunk = policy.predict_action(obs if task is None else {**obs, "task": task})["action_pred"][0]
    report, executed = policy.last_report, range(spec.chunk.start, spec.chunk.stop)
    assert report is not None  # a call was made
    notes = [f"{key}: one frame stands for all {spec.observations[key].frames} that are read" for key in repeated]
    told, identity = f"plan {report.plan_name!r}, seed {seed}", artifact.manifest.identity
    if as_json:
        how = {"plan": report.plan_name, "seed": seed, "executed": [executed.start, executed.stop], "notes": notes}
        print_json({"identity": identity, **how, "actions": chunk.tolist()})
    else:
        say(output := results(), f"{'step':<15}{''.join(f'{number:>10}' for number in range(chunk.shape[1]))}")
        for step, action in enumerate(chunk):
            numbers = "".join(f"{number:>10.4g}" for number in action)
            say(output, f"{step:>4} {'executed' * (step in executed):<10}{numbers}")
        say(output, f"{told}: {len(chunk)} steps of {chunk.shape[1]} numbers", *notes)
        print_identity(identity, output)
    if picture is not None:
        write_picture(plot_chunk(chunk, executed, told), picture)
        say(progress(), f"wrote {picture}")
