"""A few hundred cases of the fuzzer; the record of the long run is in docs/security.md."""

import json
import random
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.hostile import swollen
from tests.hostile.corpus import make
from tests.hostile.fuzz import LIMIT
from tests.hostile.guard import MORE_BYTES, Violation, address_space
from tests.hostile.targets import Accepted, outcome
from tests.once import Once

ROOT = Path(__file__).resolve().parents[2]
CASES = 120


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "cases", "each"),
    [("mixed", CASES, 10), ("structured", 80, 3), pytest.param("structured", 50_000, 2_000, marks=pytest.mark.soak)],
)
def test_nothing_but_errors_of_its_own(target: str, cases: int, each: int, once: Once) -> None:
    """More than ``each`` are refused, and more than that accepted."""
    corpus = once.folder("corpus", make)
    command = [sys.executable, "-m", "tests.hostile.fuzz", "--corpus", str(corpus), "--processes", "1"]
    command += ["--target", target, "--cases", str(cases), "--seed", "1"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300 + cases)
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert (result.returncode, result.stderr, lines[:-1]) == (0, "", [])
    assert lines[-1]["refused"] + lines[-1]["accepted"] == cases
    assert min(lines[-1]["refused"], lines[-1]["accepted"]) > each


@pytest.mark.parametrize("case", range(8))
def test_an_artifact_that_is_swollen_takes_no_more_than_is_promised(written: Path, case: int) -> None:
    """The first cases of many: ``python -m tests.hostile.fuzz --target swollen --cases 1400``."""
    use = swollen.artifact(random.Random(case), written)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (address_space() + MORE_BYTES, hard))
    began = time.process_time()
    try:
        outcome(use)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.process_time() - began < LIMIT


def test_a_case_that_is_no_error_of_its_own_is_a_defect() -> None:
    def other() -> None:
        raise KeyError("x")

    with pytest.raises(KeyError):
        outcome(other)


def test_the_guard_sees_what_must_not_happen(tmp_path: Path) -> None:
    """In a process of its own, because an audit hook stays."""
    code = f"""
import os, pathlib, pickle, sys
from tests.hostile.guard import Guard, Violation
inside = pathlib.Path({str(tmp_path)!r}) / "inside"
inside.mkdir()
guard = Guard(inside)
with guard.watching():
    (inside / "a").write_text("x")
    (inside / "a").rename(inside / "b")
    (inside / "b").unlink()
outside = inside.parent / "outside"
def swallowed():
    try:
        os.mkdir(outside)
    except BaseException:
        pass
for act in (
    lambda: outside.write_text("x"),
    lambda: os.system("true"),
    lambda: os.symlink("/etc/passwd", outside),
    lambda: eval("1 + 1"),
    lambda: pickle.loads(pickle.dumps(os.mkdir)),
    lambda: bytearray(3 << 30),
    swallowed,
):
    try:
        with guard.watching():
            act()
    except (Violation, MemoryError) as error:
        print(type(error).__name__)
print(outside.exists())
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["Violation"] * 5 + ["MemoryError", "Violation", "False"]


def test_a_violation_is_no_exception_that_a_loader_could_take_for_damage() -> None:
    assert not issubclass(Violation, Exception)
    assert issubclass(Accepted, AssertionError)
