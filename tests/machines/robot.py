"""What a machine with the runtime alone is held to: its own answers beside those of the machine that compiled.

    python tests/machines/robot.py MADE [--artifacts | PYTEST OPTIONS]

MADE is the folder that ``made.py`` filled, on x86 with the compiler. This needs ttscompile with numpy and onnxruntime,
websockets, pytest and hypothesis, and refuses to run beside torch or onnx. It runs ``doctor`` and ``verify``, compares
actions, and runs the tests that need no compiler, unless ``--artifacts`` leaves them out. Exit status 1 if anything
fails. No time is measured.
"""

import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

ROOT = Path(__file__).resolve().parents[2]
COMPILERS = ("torch", "diffusers", "onnx", "onnxscript")
TOLERANCE = 1e-5
"""Of the range of the actions, where everything is fp32."""

GROWTH = 2.0
"""How much further than on x86 actions with eight-bit blocks may be from fp32. Kernels of different processors round to
different eight-bit numbers: they are as far from each other as each is from fp32."""

TESTS = (
    *("tests/runtimes/executor", "tests/cli/test_ending.py", "tests/cli/test_words.py"),
    *(
        "tests/core/test_correction.py",
        "tests/core/test_lattice.py",
        "tests/measure/test_machine.py",
        "tests/measure/test_timer.py",
    ),
    *(f"tests/serving/test_{name}.py" for name in ("admission", "floods", "listen", "metrics", "protocol")),
)
LEFT_OUT = tuple(
    f"tests/runtimes/executor/test_{name}.py" for name in ("caches", "poses", "prefix", "scenes", "tokens")
)
"""They make artifacts of their own, or import diffusers for its schedulers."""

ARTIFACTS = "--artifacts"
MARKS = "not alone and not soak and not compiles"


class Check(NamedTuple):
    """What was looked at, whether it is as it should be, and what was found."""

    what: str
    passed: bool
    found: str


def main(made: Path, options: Sequence[str]) -> int:
    """Run everything and print a line for each check; 0 if all passed."""
    if beside := [name for name in COMPILERS if importlib.util.find_spec(name) is not None]:
        print(f"{sys.executable}: found {', '.join(beside)}. This is about machines that have the runtime alone.")
        return 2
    checks = []
    for check in of_artifacts(made):
        checks.append(check)
        print(f"{'passed' if check.passed else 'FAILED'}  {check.what:<40}  {check.found}", flush=True)
    if ARTIFACTS in options:
        return int(not all(check.passed for check in checks))
    tests = run_tests(made / "once", options)
    print(f"{'FAILED' if tests else 'passed'}  tests without the compiler, exit status {tests}")
    return int(bool(tests) or not all(check.passed for check in checks))


def of_artifacts(made: Path) -> Iterator[Check]:
    """``doctor``, ``verify`` and the actions of every artifact."""
    for folder in sorted(path.parent for path in made.glob("*/artifact")):
        artifact = folder / "artifact"
        for command in ("doctor", "verify"):
            status, told = run_command(command, artifact)
            yield Check(f"{command} {folder.name}", status == 0, told)
        yield from compare(folder.name, artifact, folder / "actions.npz")


def run_command(command: str, artifact: Path) -> tuple[int, str]:
    """Exit status of a command with ``--json``, and in a line what it says."""
    words = [sys.executable, "-m", "ttscompile", command, str(artifact.resolve()), "--json"]
    # In a folder without the package's source, which would hide what is installed.
    done = subprocess.run(words, cwd=artifact.parent, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        return done.returncode, f"exit status {done.returncode}: {done.stderr.strip()[-2000:]}"
    document = json.loads(done.stdout)
    if command == "doctor":
        problems = [each["found"] for each in document["findings"] if each["level"] == "problem"]
        instructions = [each["found"] for each in document["findings"] if each["what"] == "instructions"]
        return done.returncode, f"{document['warnings']} warnings; {'; '.join(problems or instructions)}"
    return done.returncode, ", ".join(f"{rung['name']} {rung['status']}" for rung in document["rungs"])


def compare(name: str, artifact: Path, actions: Path) -> Iterator[Check]:
    """The executed actions of each precision and plan against those of the machine that compiled."""
    with np.load(actions) as stored:
        given = dict(stored)
    variants = dict.fromkeys(tuple(key.split("/")[2:]) for key in given if "/action/" in key)
    for precision, plan in variants:
        calls = sorted(key.split("/")[0] for key in given if key.endswith(f"/action/{precision}/{plan}"))
        expected, exact = (
            np.stack([given[f"{call}/action/{each}/{plan}"] for call in calls]) for each in (precision, "fp32")
        )
        found = act(artifact, precision, plan, [of_call(given, call, plan) for call in calls])
        allowed = TOLERANCE if precision == "fp32" else GROWTH * apart(expected, exact) + TOLERANCE
        yield judged(f"actions {name} {precision} {plan}", found, exact, allowed, apart(found, expected))


def of_call(given: Mapping[str, Array], call: str, plan: str) -> tuple[dict[str, Array], tuple[Array, Array | None]]:
    """Observation and noise of a call; that of its steps is of the loop of the plan."""
    prefix = f"{call}/obs/"
    obs = {key.removeprefix(prefix): value for key, value in given.items() if key.startswith(prefix)}
    return obs, (given[f"{call}/noise"], given.get(f"{call}/steps/{plan}"))


def act(
    artifact: Path, precision: str, plan: str, calls: Sequence[tuple[dict[str, Array], tuple[Array, Array | None]]]
) -> Array:
    """Executed actions ``[calls, B, Ta, Da]`` of an episode."""
    import ttscompile

    policy = ttscompile.load(artifact, plan=f"{plan}@{precision}")
    policy.reset()
    made = [policy.predict_action(obs, noise=ttscompile.Noise(*noise)) for obs, noise in calls]
    return np.stack([each["action"] for each in made])


def apart(found: Array, expected: Array) -> float:
    """The largest difference, as a share of the range of what is expected."""
    return float(np.abs(found.astype(np.float64) - expected).max() / np.ptp(expected))


def judged(what: str, found: Array, exact: Array, allowed: float, other: float) -> Check:
    """Actions of this machine against those in fp32 of the one that compiled; ``other``: against its own precision."""
    error = apart(found, exact)
    told = f"{len(found)} calls: {error:.1e} of the range from x86 in fp32, {allowed:.1e} allowed"
    return Check(what, error <= allowed, f"{told}; {other:.1e} from x86 in the same precision")


def run_tests(once: Path, options: Sequence[str]) -> int:
    """The tests that need no compiler, in a copy without the package's source: it would hide what is installed."""
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        for part in ("tests", "docs", "examples/serve"):
            shutil.copytree(
                ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__", "golden", "pictures")
            )
        shutil.copy(ROOT / "pyproject.toml", copy)
        command = [sys.executable, "-m", "pytest", *selected(once), *options]
        return subprocess.run(command, cwd=copy, check=False).returncode


def selected(once: Path) -> list[str]:
    """What pytest is told of the tests that need no compiler."""
    words = ["-q", "-p", "no:cacheprovider", "--benchmark-disable", "-m", MARKS, "--made", str(once.resolve())]
    return [*words, *(f"--ignore={path}" for path in LEFT_OUT), *TESTS]


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
