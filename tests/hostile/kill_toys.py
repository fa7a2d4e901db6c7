"""Kill at each operation on files that writing a small artifact, updating it and saving a state take."""

import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.hostile.fuzz import memory
from tests.hostile.kill import PREFIX, contents, events, finish, killed_at


def main() -> None:
    """Print a JSON line for each scenario."""
    import torch

    from tests.plans import store_schedules
    from tests.runtimes.toys import toy_program
    from ttscompile.artifact.load import load_artifact
    from ttscompile.artifact.write import write_artifact
    from ttscompile.calibration.state import StateFile
    from ttscompile.lower.program import lower_program

    torch.set_num_threads(1)
    programs = [toy_program(2, 2, seed=seed) for seed in (0, 1)]
    models = lower_program(programs[0])  # which hold no weights
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=memory()) as name:
        folder = Path(name)
        old, new, updated = (folder / each for each in ("old", "new", "updated"))
        for path, program in zip((old, new), programs, strict=True):
            write_artifact(program, models, path)
        plan = np.array([[0, 0], [2, 2]], np.int8)

        def write(path: Path) -> None:
            write_artifact(programs[1], models, path)

        pruner = {name: value + 1 for name, value in load_artifact(new).pruner.items()}

        def update(path: Path) -> None:
            store_schedules(path, pruner, {"schedule": plan}, "schedule", {"seed": 1})

        def save(path: Path) -> None:
            state = StateFile(path, {"a": 1})
            state.arrays, state.progress = {"x": np.arange(1000)}, {"intervals": 2}
            state.save()

        shutil.copytree(new, updated)
        update(updated)
        tell("write fresh", folder, None, write, lambda path: contents(path) == contents(new))
        tell("write again", folder, old, write, lambda path: contents(path) in (contents(old), contents(new)))
        tell(
            "update",
            folder,
            new,
            update,
            lambda path: load_artifact(path).manifest.identity in identities(new, updated),
        )
        saved = folder / "saved"
        saved.mkdir()
        save(saved)
        tell("save state", folder, saved, save, lambda path: StateFile(path, {"a": 1}).load())


def identities(*paths: Path) -> list[str]:
    """Of artifacts."""
    from ttscompile.artifact.load import load_artifact

    return [load_artifact(path).manifest.identity for path in paths]


def tell(
    name: str, folder: Path, before: Path | None, operation: Callable[[Path], None], whole: Callable[[Path], bool]
) -> None:
    """Kill at every operation; then let it run, which must leave what it always makes, and nothing beside it."""
    work = folder / "work"
    target, failures = work / "compiled", []

    def start() -> None:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        if before is not None:
            shutil.copytree(before, target)

    start()
    count = events(lambda: operation(target))
    expected = contents(target)
    for event in range(1, count + 1):
        start()
        if not killed_at(lambda: operation(target), event):
            failures.append(f"operation {event} of {count} did not come")
        if (before is not None or target.exists()) and not whole(target):
            failures.append(f"killed at operation {event} of {count}, it left {sorted(contents(target))}")
        finish(lambda: operation(target))
        if name != "save state" and contents(target) != expected:
            failures.append(f"after operation {event} of {count}, the next run made {sorted(contents(target))}")
        if [path.name for path in work.iterdir()] != ["compiled"]:
            failures.append(f"killed at operation {event} of {count}, it left something beside the artifact")
    sys.stdout.write(json.dumps({"scenario": name, "kills": count, "failures": failures}) + "\n")


if __name__ == "__main__":
    main()
