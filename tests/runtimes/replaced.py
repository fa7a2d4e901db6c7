"""Load an artifact while another process replaces it: is each policy wholly one of those that were there?

    python tests/runtimes/replaced.py --loads 10000
    python tests/runtimes/replaced.py --ways commands --loads 1000000 --seconds 300

Prints one JSON document, and ends with status 1 if a policy was mixed; the tests beside this file run short versions.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import ttscompile
from tests.plans import store_schedules
from ttscompile.artifact.files import beside, exchange, replace_folder
from ttscompile.artifact.load import read_manifest
from ttscompile.core.spec import PolicySpec
from ttscompile.errors import ArtifactError
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.random_calls import random_calls

CHANGES = ("exchange", "back", "replace", "in_place", "calibrate")
COMMANDS = "commands"
"""A way for itself: what is there are artifacts of ``CHECKPOINT`` with ``STEPS``, and a change takes seconds."""
CHECKPOINT = Path(__file__).parents[2] / "examples" / "policies" / "metaworld" / "metaworld_dpt_ema_fp16.ckpt"
STEPS = (4, 8)


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
    elif how == COMMANDS:
        convert(target, random.choice(STEPS))
        calibrate(target)
    else:
        reuse(target, random.choice((1, 2)))


def convert(target: Path, steps: int) -> None:
    """The command, as a process of its own."""
    run("convert", str(CHECKPOINT), "-o", str(target), "--sampler", "ddim", "--steps", str(steps))


def calibrate(target: Path) -> None:
    """The command, with even steps, which are the same every time, and the recording beside the artifact."""
    recording = str(target.with_name("calls.npz"))
    run("calibrate", str(target), "--trajectories", recording, "--learn", "interval", "--target-sparsity", "0.5")


def run(*words: str) -> None:
    """Run ``ttscompile`` with these words; what it says is shown where it fails."""
    ended = subprocess.run([sys.executable, "-m", "ttscompile", *words], capture_output=True, text=True, check=False)
    warned = "scores may fall" in ended.stderr  # even steps without a correction are far from the original
    assert ended.returncode == int(warned), ended.stderr


def reuse(target: Path, source: int) -> None:
    """Give an artifact a plan that computes the first step and reuses all others from one source."""
    manifest = read_manifest(target)
    plan = np.full((manifest.steps, len(manifest.blocks)), source, np.int8)
    plan[0] = 0
    store_schedules(target, None, {"schedule": plan}, "schedule", {})


def keep_changing(target: Path, others: Sequence[Path], ways: Sequence[str], longest: float) -> None:
    """Change it until this process is killed. Each change adds a line to the file ``changes`` beside it."""
    while True:
        time.sleep(random.uniform(0, longest))
        how = random.choice(ways)
        try:
            change(how, target, others)
        except ArtifactError:  # what was copied there is not whole at this moment
            continue
        with target.with_name("changes").open("a") as made:
            made.write(f"{how}\n")


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
    # With the commands that it runs it is a group, which ends together.
    with subprocess.Popen([*command, "--ways", *ways], start_new_session=True) as changing:
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
            with suppress(ProcessLookupError):  # it has ended by itself, which is the error
                os.killpg(changing.pid, signal.SIGKILL)
    return made


def prepared(folder: Path) -> tuple[Path, list[Path], dict[str, bytes]]:
    """A target, the two artifacts that take turns there, and the answers of all that can be there."""
    from tests.runtimes.toys import toy_program, written_artifact

    others = [written_artifact(toy_program(2, 2, seed=seed), folder / f"artifact-{seed}").path for seed in (0, 1)]
    shutil.copytree(others[0], folder / "target")
    shutil.copytree(others[1], folder / "spare")
    return folder / "target", others, answers(others, folder)


def prepared_by_commands(folder: Path) -> tuple[Path, list[Path], dict[str, bytes]]:
    """The same of ``COMMANDS``: what is there was converted, or calibrated too."""
    others, expected = [folder / f"steps-{steps}" for steps in STEPS], {}
    for path, steps in zip(others, STEPS, strict=True):
        convert(path, steps)
        spec = read_manifest(path).spec
        windows = [obs for obs, _ in random_calls(spec, 24, seed=1)]
        arrays: dict[str, Any] = {key: np.concatenate([window[key] for window in windows]) for key in spec.observations}
        np.savez(folder / "calls.npz", **arrays, episode_ends=np.array([6, 12, 18, 24]))
        for calibrated in (False, True):
            if calibrated:
                calibrate(path)
            policy = ttscompile.load(path)
            expected[policy.info.identity] = answer(policy, spec)
    shutil.copytree(others[0], folder / "target")
    return folder / "target", others, expected


def main() -> int:
    """Load, or with ``--change`` be the process that replaces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loads", type=int, default=10000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop then, however many were made")
    parser.add_argument("--ways", nargs="+", choices=(*CHANGES, COMMANDS), default=CHANGES)
    parser.add_argument("--longest", type=float, default=0.05, help="seconds between two changes")
    parser.add_argument("--change", nargs=3, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if COMMANDS in options.ways and len(options.ways) > 1:
        parser.error(f"{COMMANDS} is a way for itself")
    if options.change is not None:
        keep_changing(options.change[0], options.change[1:], options.ways, options.longest)
    with tempfile.TemporaryDirectory() as name:
        there = (prepared_by_commands if COMMANDS in options.ways else prepared)(Path(name))
        Path(name, "changes").touch()
        began = time.monotonic()
        made = load_often(*there, options.loads, options.ways, options.longest, options.seconds)
        changes = Counter(Path(name, "changes").read_text().split())
    print(
        json.dumps(
            {
                "ways": options.ways,
                "changes": dict(changes),
                "loads": made.total(),
                "made": dict(made),
                "seconds": round(time.monotonic() - began, 1),
            }
        )
    )
    return 1 if made["mixed"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
