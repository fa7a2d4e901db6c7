"""What is fuzzed: for each, a folder of good files, one bad file a case, and what a user would do with it."""

import json
import random
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from unittest import mock

from tests.hostile import dataset_changes, forged, hdf5_changes, messages, pickles, swollen, zarr_changes
from tests.hostile.archives import write, write_hostile
from tests.hostile.hdf5_changes import SECRET
from tests.hostile.mutate import changed, damaged
from ttscompile.errors import CalibrationError, ExecutorError, TtscompileError

Case = Callable[[random.Random, Path, Path], Callable[[], None]]
"""From random numbers, the corpus and an empty folder to what has to refuse or to work; makes the bad file."""


class Accepted(AssertionError):
    """A file that was damaged, and was loaded."""


def artifact(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """A directory: one file damaged; or forged, with hashes that are right again."""
    source = rng.choice(sorted((corpus / "artifacts").iterdir()))
    path = Path(shutil.copytree(source, folder / "compiled"))
    if rng.random() < 0.25:
        return _damaged_artifact(rng, path)
    return forged.artifact(rng, path)


def swell(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """A directory or a zip, sound in form and far too large; see ``swollen``."""
    source = rng.choice(sorted((corpus / "artifacts").iterdir()))
    return swollen.artifact(rng, Path(shutil.copytree(source, folder / "compiled")))


def _damaged_artifact(rng: random.Random, path: Path) -> Callable[[], None]:
    from ttscompile.artifact.load import load_artifact

    victim = rng.choice(sorted(path.iterdir()))
    before = victim.read_bytes()
    kind = rng.randrange(12)
    victim.unlink()
    if kind == 0:
        victim.symlink_to("/etc/passwd")
    elif kind == 1:
        victim.mkdir()
    elif kind > 2:
        victim.write_bytes(damaged(rng, before))

    def load() -> None:
        load_artifact(path)
        if victim.read_bytes() != before and victim.name != "manifest.json":
            raise Accepted(f"{victim.name} was changed")

    return load


def zipped(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """A zipped artifact."""
    source = rng.choice(sorted((corpus / "artifacts").iterdir()))
    files = {path.name: path.read_bytes() for path in sorted(source.iterdir())}
    target, kind = folder / "compiled.zip", rng.random()
    if kind < 0.3:
        write(target, files, rng)
        target.write_bytes(damaged(rng, target.read_bytes()))
    elif kind < 0.4:
        path = Path(shutil.copytree(source, folder / "compiled"))
        forged.artifact(rng, path)
        files = {each.name: each.read_bytes() for each in sorted(path.iterdir())}
        shutil.rmtree(path)
        write(target, files, rng)
    else:
        write_hostile(target, files, rng)
    return lambda: forged.use(target)


def checkpoint(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """A checkpoint of Diffusion Policy."""
    from ttscompile.frontends import load_checkpoint_policy

    target = folder / "policy.ckpt"
    pickles.write(rng, corpus / "checkpoints", target)

    def load() -> None:
        load_checkpoint_policy(target)

    return load


def lerobot(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """A directory of LeRobot's, with the configuration of its encoders beside it."""
    from ttscompile.frontends import load_checkpoint_policy

    path = Path(shutil.copytree(rng.choice(sorted((corpus / "lerobot").iterdir())), folder / "lerobot"))
    files = sorted(file for file in path.rglob("*") if file.is_file())
    victim = rng.choice([*files, *[file for file in files if file.suffix == ".json"]])
    before = victim.read_bytes()
    if rng.random() < 0.2:
        victim.write_bytes(damaged(rng, before))
    elif victim.suffix == ".json":
        victim.write_text(json.dumps(changed(rng, json.loads(before))))
    else:
        victim.write_bytes(forged.changed_tensors(rng, before))

    def load() -> None:
        load_checkpoint_policy(path / "policy", format="lerobot")

    return load


def trajectories(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """A recording of episodes."""
    from ttscompile.core.spec import ObservationSpec
    from ttscompile.trajectories import load_trajectories

    target = folder / "calls.npz"
    pickles.write_npz(rng, corpus / "trajectories", target)
    observations = {"obs": ObservationSpec((2,))}

    def load() -> None:
        episodes = load_trajectories([target], observations, 2)
        if not all(episode.calls >= 1 for episode in episodes):
            raise Accepted("an episode without calls")

    return load


def recording(kind: str, write_bad: Callable[[random.Random, Path, Path], Path]) -> Case:
    """A data set in a format of others, of which two arrays are joined, or its images taken."""

    def make(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
        from tests.trajectories.data_sets import read_here
        from ttscompile.core.spec import ObservationSpec
        from ttscompile.trajectories import load_trajectories, sandbox

        joined = {"obs": ObservationSpec((2, 8))}, {"obs": ("keypoint", "state:2")}
        images = {"image": ObservationSpec((2, 3, 5, 4)), "state": ObservationSpec((2, 5))}, {"image": ("img",)}
        path = write_bad(rng, corpus / "recordings" / kind, folder)
        observations, sources = rng.choice((joined, joined, images))

        def load() -> None:
            with mock.patch.object(sandbox, "reader", read_here):
                episodes = load_trajectories([path], observations, 2, sources)
            for array in (array for episode in episodes for array in episode.observations.values()):
                if not len(array) or (array == SECRET).any():
                    raise Accepted(f"an episode of {len(array)} calls, or with numbers of another file")

        return load

    return make


def protocol(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """A message to the executor's server; a refusal is an answer that names an error of ttscompile."""
    text = messages.draw(rng)

    def send() -> None:
        kind, message = messages.reply(text)
        if kind is not None:
            raise ExecutorError(f"{kind}: {message}")

    return send


def state(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """What an interrupted calibration left."""
    from ttscompile.calibration.state import FILE, StateFile

    source = corpus / "states" / FILE
    content = source.read_bytes()
    changed = damaged(rng, content) if rng.random() < 0.3 else forged.state(rng, content)
    (folder / FILE).write_bytes(changed)
    settings = {"model": "0" * 16, "seed": 0, "budget": {"kind": "sparsity", "value": 0.9}}

    def load() -> None:
        loaded = StateFile(folder, settings)
        if not loaded.load():
            raise CalibrationError("nothing to resume")
        loaded.get("search")

    return load


TARGETS: dict[str, Case] = {
    "artifact": artifact,
    "swollen": swell,
    "zip": zipped,
    "checkpoint": checkpoint,
    "lerobot": lerobot,
    "trajectories": trajectories,
    "zarr": recording("zarr", zarr_changes.write_bad),
    "hdf5": recording("hdf5", hdf5_changes.write_bad),
    "lerobot-dataset": recording("lerobot-dataset", dataset_changes.write_bad),
    "protocol": protocol,
    "state": state,
}
READ_APART = ("zarr", "hdf5", "lerobot-dataset")
"""Targets that are read in a process of their own: a crash of their libraries ends that process, and is told."""


def mixed(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """One of them."""
    return rng.choice([*TARGETS.values()])(rng, corpus, folder)


def structured(rng: random.Random, corpus: Path, folder: Path) -> Callable[[], None]:
    """An artifact of somebody who knows the format: forged, and one in ten swollen; hashes are always right."""
    source = rng.choice(sorted((corpus / "artifacts").iterdir()))
    path = Path(shutil.copytree(source, folder / "compiled"))
    return rng.choice([swollen.artifact, *[forged.artifact] * 9])(rng, path)


MIXES: dict[str, Case] = {"mixed": mixed, "structured": structured}
"""Targets that are made of others, and are not among all of them."""


def outcome(case: Callable[[], None]) -> str:
    """``refused`` or ``accepted``; whatever else comes out of the case is a defect, and goes on to the caller."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            case()
        except TtscompileError as error:
            text = str(error)
            if not text.strip() or "Traceback" in text:
                raise Accepted(f"a message that says nothing: {text[:200]!r}") from error
            return "refused"
    return "accepted"
