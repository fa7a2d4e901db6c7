"""Load an artifact while another process replaces it: is each policy wholly one of those that were there?

    python tests/runtimes/replaced.py --loads 10000

Prints one JSON document, and ends with status 1 if a policy was mixed; the tests beside this file run short versions.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import ttscompile
from ttscompile.artifact.files import beside, exchange, replace_folder
from ttscompile.artifact.load import read_manifest
from ttscompile.artifact.write import update_calibration
from ttscompile.core.spec import PolicySpec
from ttscompile.errors import ArtifactError
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.random_calls import random_calls

CHANGES = ("exchange", "back", "replace", "in_place", "calibrate")


def change(how: str, target: Path, others: Sequence[Path]) -> None:
    """Change what is at ``target`` in one of the ways of ``CHANGES``; ``others`` are two artifacts."""
    if how == "exchange":  # with a third, which comes back the next time
        exchange(target, others[0].with_name("spare"))
    elif how == "back":
        exchange(target, others[0].with_name("spare"))
        time.sleep(random.uniform(0, 0.01))
        exchange(target, others[0].with_name("spare"))
    elif how == "replace":  # as ``convert`` does
        partial = beside(target)
        shutil.copytree(random.choice(others), partial)
        replace_folder(partial, target)
    elif how == "in_place":  # as ``cp`` and ``rsync --inplace`` do
        for path in random.choice(others).iterdir():
            (target / path.name).write_bytes(path.read_bytes())
    else:
        reuse(target, random.choice((1, 2)))


def reuse(target: Path, source: int) -> None:
    """Give an artifact a plan that computes the first step and reuses all others from one source."""
    manifest = read_manifest(target)
    plan = np.full((manifest.steps, len(manifest.blocks)), source, np.int8)
    plan[0] = 0
    update_calibration(target, None, {"schedule": plan}, "schedule", {})


def keep_changing(target: Path, others: Sequence[Path], ways: Sequence[str], longest: float) -> None:
    """Change it until this process is killed."""
    while True:
        time.sleep(random.uniform(0, longest))
        try:
            change(random.choice(ways), target, others)
        except ArtifactError:  # what was copied there is not whole at this moment
            continue


def answer(policy: CompiledPolicy, spec: PolicySpec) -> bytes:
    """What a policy answers to the call that all are asked."""
    ((obs, noise),) = random_calls(spec, 1, seed=0)
    return bytes(policy.predict_action(obs, noise=noise)["action_pred"].tobytes())


def answers(others: Sequence[Path], folder: Path) -> dict[str, bytes]:
    """By identity, the answers of all that ``change`` can leave at its target."""
    found = {}
    for number, path in enumerate(others):
        for fill in (0, 1, 2):
            copy = folder / f"expected-{number}-{fill}"
            shutil.copytree(path, copy)
            if fill:
                reuse(copy, fill)
            policy = ttscompile.load(copy)
            found[policy.info.identity] = answer(policy, read_manifest(copy).spec)
    return found


def load_often(
    target: Path,
    others: Sequence[Path],
    expected: Mapping[str, bytes],
    loads: int,
    ways: Sequence[str],
    longest: float,
    seconds: float = float("inf"),
) -> Counter[str]:
    """How many loads gave which policy, which error, or a mixture; fewer than ``loads`` where time is up."""
    made: Counter[str] = Counter()
    asked = read_manifest(others[0]).spec
    command = [sys.executable, __file__, "--change", *map(str, (target, *others)), "--longest", str(longest)]
    with subprocess.Popen([*command, "--ways", *ways]) as changing:
        try:
            ends = time.monotonic() + seconds
            while made.total() < loads and time.monotonic() < ends:
                try:
                    policy = ttscompile.load(target)
                    right = expected[policy.info.identity] == answer(policy, asked)
                    made[policy.info.identity[:12] if right else "mixed"] += 1
                except ArtifactError as error:
                    made[type(error).__name__] += 1
            assert changing.poll() is None, "nothing changed the artifact any more"
        finally:
            changing.kill()
    return made


def prepared(folder: Path) -> tuple[Path, list[Path], dict[str, bytes]]:
    """A target, the two artifacts that take turns there, and the answers of all that can be there."""
    from tests.runtimes.toys import toy_program, written_artifact

    others = [written_artifact(toy_program(2, 2, seed=seed), folder / f"artifact-{seed}").path for seed in (0, 1)]
    shutil.copytree(others[0], folder / "target")
    shutil.copytree(others[1], folder / "spare")
    return folder / "target", others, answers(others, folder)


def main() -> int:
    """Load, or with ``--change`` be the process that replaces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loads", type=int, default=10000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop then, however many were made")
    parser.add_argument("--ways", nargs="+", choices=CHANGES, default=CHANGES)
    parser.add_argument("--longest", type=float, default=0.05, help="seconds between two changes")
    parser.add_argument("--change", nargs=3, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.change is not None:
        keep_changing(options.change[0], options.change[1:], options.ways, options.longest)
    with tempfile.TemporaryDirectory() as name:
        began = time.monotonic()
        made = load_often(*prepared(Path(name)), options.loads, options.ways, options.longest, options.seconds)
    print(
        json.dumps(
            {
                "ways": options.ways,
                "loads": made.total(),
                "made": dict(made),
                "seconds": round(time.monotonic() - began, 1),
            }
        )
    )
    return 1 if made["mixed"] else 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    raise SystemExit(main())
