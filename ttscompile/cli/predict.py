"""``ttscompile predict``: the chunk of actions that an artifact answers to one observation.

That is given in the words of a command line: pictures, a state, or an archive of arrays.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np

from ttscompile.artifact.load import load_artifact
from ttscompile.cli.options import artifact_argument, json_option, seed_option
from ttscompile.cli.output import print_identity, print_json, progress, results, say
from ttscompile.cli.types import FILE, PATH, PICTURE, TEXT
from ttscompile.core.coercion import Array
from ttscompile.core.spec import ObservationSpec, PolicySpec
from ttscompile.errors import ObservationError, needing
from ttscompile.plots.figure import write_picture
from ttscompile.plots.frontier import plot_chunk
from ttscompile.runtimes.load import open_policy
from ttscompile.trajectories.episodes import read_npz

_TASK = "--task TEXT"


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
@click.option("--task", type=TEXT, help="Give this instruction to a policy that reads one.")
@click.option(
    "--tokenizer",
    type=PATH,
    help="Read the task with this tokenizer.json, or that of this folder, in place of the artifact's own.",
)
@click.option(
    "--observation", "archive", type=FILE, help="Take arrays by key from this .npz: whatever the policy reads."
)
@click.option("--plan", type=TEXT, help="Compute this plan. Without this option it is the default plan.")
@click.option("--plot", "picture", type=PICTURE, help="Draw the chunk into this file (.png, .svg or .pdf).")
@seed_option("Draw the noise that the actions are made of with this seed.")
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
    if task is not None and (spec.instruction is None or (tokenizer or artifact.tokenizer) is None):
        compiled = f"the policy reads no text; compiled in is {spec.source.get('task', 'none')!r:.100}"
        told = compiled if spec.instruction is None else "the artifact has no tokenizer; name one by --tokenizer PATH"
        raise ObservationError(f"{directory}: --task {task!r:.100}: {told}. Or give tokens in --observation FILE.npz.")
    options = {key: _option(key, spec) for key in spec.observations if key not in obs}
    if told := ", ".join(f"{key} ({how})" for key, how in options.items() if task is None or how != _TASK):
        raise ObservationError(f"the observation lacks {told}. Give it so, or arrays by key: --observation FILE.npz.")
    with progress().status("loading"):
        policy = open_policy(artifact, seed=seed, plan=plan, tokenizer=tokenizer)
    chunk = policy.predict_action(obs if task is None else {**obs, "task": task})["action_pred"][0]
    report, executed = policy.last_report, range(spec.chunk.start, spec.chunk.stop)
    assert report is not None  # a call was made
    notes = [f"{key}: one frame stands for all {spec.observations[key].frames} that are read" for key in repeated]
    if policy.info.follows:
        asked = f"plan {policy.info.default_plan!r} begins with the chunk of the call before"
        notes.append(f"{asked}; a first call has none, and computes plan {report.plan_name!r}")
    told, identity = f"plan {report.plan_name!r}, seed {seed}", artifact.manifest.identity
    if as_json:
        how = {"plan": report.plan_name, "seed": seed, "executed": [executed.start, executed.stop], "notes": notes}
        print_json({"identity": identity, **how, "actions": chunk.tolist()})
    else:
        say(output := results(), f"{'step':<14}{''.join(f'{number:>11}' for number in range(chunk.shape[1]))}")
        for step, action in enumerate(chunk):
            numbers = "".join(f"{number:>11.4g}" for number in action)
            say(output, f"{step:>4} {'executed' * (step in executed):<9}{numbers}")
        say(output, f"{told}: {len(chunk)} steps of {chunk.shape[1]} numbers", *notes)
        print_identity(identity, output)
    if picture is not None:
        write_picture(plot_chunk(chunk, executed, told), picture)
        say(progress(), f"wrote {picture}")


def observed(
    specs: Mapping[str, ObservationSpec], pictures: Mapping[str, Path], state: Array | None, archive: Path | None
) -> tuple[dict[str, Array], list[str]]:
    """The observation as ``predict_action`` takes it, one stream; and the keys of which one frame fills the window.

    Pictures are by the key of a camera, or the end of it; the archive is an ``.npz`` with arrays by key.

    Raises:
        ObservationError: a name or a picture that does not fit, or a key twice.
        TrajectoryError: the archive cannot be read.
    """
    given = {} if archive is None else read_npz(archive)
    more = [(_camera(name, specs), name, path) for name, path in pictures.items()]
    parts = [(key, _picture(path, specs[key], f"--image {name}={path}")) for key, name, path in more]
    if state is not None:
        vectors = _vectors(specs)
        if len(vectors) != 1:
            told = f"--state is for the one vector of a policy; this one reads {', '.join(vectors) or 'none'}"
            raise ObservationError(f"{told}. Give all in an archive: --observation FILE.npz.")
        parts.append((vectors[0], state))
    for key, array in parts:
        if key in given:
            raise ObservationError(f"{key} is given twice. Leave out one picture, --state, or the array in {archive}.")
        given[key] = array
    whole = {key: _window(array, specs[key]) if key in specs else (array, False) for key, array in given.items()}
    return {key: array for key, (array, _) in whole.items()}, [key for key, (_, one) in whole.items() if one]


def _vectors(specs: Mapping[str, ObservationSpec]) -> list[str]:
    """The vectors that --state may be: all of them, or those that are called so."""
    vectors = [key for key, one in specs.items() if not one.image and np.dtype(one.dtype).kind == "f"]
    return [key for key in vectors if key.rpartition(".")[2] == "state"] or vectors


def _option(key: str, spec: PolicySpec) -> str:
    """The option that gives this observation."""
    told = spec.instruction
    if spec.observations[key].image:
        return f"--image {key}=FILE"
    if told is not None and key in (told.tokens, told.mask):
        return _TASK
    return "--state NUMBER,.." if _vectors(spec.observations) == [key] else "--observation FILE.npz"


def _camera(name: str, specs: Mapping[str, ObservationSpec]) -> str:
    cameras = [key for key, one in specs.items() if one.image]
    found = [key for key in cameras if key == name] or [key for key in cameras if key.endswith(f".{name}")]
    if len(found) != 1:
        told = f"--image {name}: {'several cameras have' if found else 'no camera has'} this name"
        raise ObservationError(f"{told}; expected one of {', '.join(cameras) or 'none: it reads no pictures'}.")
    return found[0]


def _picture(path: Path, spec: ObservationSpec, what: str) -> Array:
    """A PNG or JPEG as float32 ``[C, H, W]`` in 0..1."""
    with needing(f"{what}: a picture", "compile", ", or give arrays with --observation FILE.npz"):
        from PIL import Image
    channels, height, width = spec.shape[-3:]
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            size = image.size
            array = np.asarray(image.convert("L" if channels == 1 else "RGB"), np.float32) / 255
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ObservationError(f"{what}: expected a picture in PNG or JPEG; {error!s:.200}.") from error
    if spec.fit is None and size != (width, height):
        told = f"{what}: expected {width}x{height} pixels, as in training; found {size[0]}x{size[1]}"
        raise ObservationError(f"{told}. Resize or crop it as the training data was.")
    return np.moveaxis(array.reshape(*array.shape[:2], channels), -1, 0)


def _window(array: Array, spec: ObservationSpec) -> tuple[Array, bool]:
    """A frame or a window as ``[1, *shape]``, and whether one frame fills it; the policy refuses other shapes."""
    with np.errstate(over="ignore"):  # infinity is refused
        array = array.astype(spec.dtype) if array.dtype.kind == "f" else array
    if array.ndim == 1 and array.size == np.prod(spec.shape):
        array = array.reshape(spec.shape)
    repeated = array.ndim < len(spec.shape)
    if repeated and spec.frames is not None:
        array = np.repeat(array[None], spec.frames, 0)
    return array if array.ndim > len(spec.shape) else array[None], repeated and (spec.frames or 1) > 1
