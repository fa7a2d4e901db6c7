"""The tests on every Python that is here, on one core, and with AVX2 alone: as far as this machine goes.

    python tests/machines/matrix.py [--all]

For each of Python 3.10 to 3.13 that is found, ``build/matrix`` gets an environment as a robot has it, and
``robot.py`` runs there; then once on one core; then, where ``qemu-x86_64-static`` is installed, on an emulated Haswell,
which has AVX2 and no AVX-512. With ``--all`` the whole suite runs as well, in this environment: as it is, on one core,
and with the switches of ``make test-avx2``. Every row is printed at the end; what was not found is a row too.
"""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))

from tests.machines.arm import CUSTOMIZE, pip, written_script  # noqa: E402
from tests.source import source_copy  # noqa: E402

PLACE = ROOT / "build" / "matrix"
COMPILING = ("3.11", "3.12", "3.13")
"""Those that the versions in ``constraints.txt`` are for."""
PYTHONS = ("3.10", *COMPILING)
BESIDE = ("pytest", "pytest-benchmark", "hypothesis")
EMULATOR, PROCESSOR = "qemu-x86_64-static", "Haswell-noTSX"
ABSENT = "not here"
ONE_CORE = ("taskset", "--cpu-list", "0")


class Row(NamedTuple):
    """What runs: its name, its words, and why not, if it cannot."""

    name: str
    words: Sequence[object]
    absent: str = ""


def main(everything: bool) -> int:
    """Run all rows, one after the other, and print how each ended; 1 if any failed."""
    made = PLACE / "made"
    if not made.exists():
        subprocess.run([sys.executable, ROOT / "tests/machines/made.py", made], check=True)
    outcomes = {}
    for row in [*rows(made), *(whole_suite() if everything else ())]:
        print(f"\n--- {row.name}: {row.absent or ' '.join(map(str, row.words))}", flush=True)
        outcomes[row.name] = ABSENT if row.absent else outcome(row.words)
    print()
    for name, told in outcomes.items():
        print(f"{told:<8}  {name}")
    return int("FAILED" in outcomes.values())


def outcome(words: Sequence[object]) -> str:
    """``passed`` or ``FAILED``."""
    return "FAILED" if subprocess.run(list(map(str, words)), cwd=ROOT, check=False).returncode else "passed"


def rows(made: Path) -> Iterator[Row]:
    """Everything without the compiler."""
    robot = ROOT / "tests/machines/robot.py"
    python: Path | None = None
    for version in PYTHONS:
        name, found = f"Python {version}, without the compiler", find_python(version)
        if found is None:
            yield Row(name, (), f"found no python{version} in PATH or among pyenv's")
            continue
        python = environment(version, found)
        yield Row(name, (python, robot, made))
    if python is not None:
        yield Row(f"one core, {python.parts[-3]}", (*ONE_CORE, python, robot, made))
        emulated = f"AVX2 alone, an emulated {PROCESSOR}, artifacts alone"
        if shutil.which(EMULATOR) is None:
            yield Row(emulated, (), f"found no {EMULATOR}: install qemu-user-static")
        else:
            script = written_script(PLACE / f"python-{PROCESSOR}", (EMULATOR, "-cpu", PROCESSOR), python)
            yield Row(emulated, (script, robot, made, "--artifacts"))


def whole_suite() -> Iterator[Row]:
    """Everything with the compiler, in the environment of the Makefile."""
    yield Row("all tests", ("make", "pytest"))
    yield Row("all tests, one core", (*ONE_CORE, "make", "pytest"))
    yield Row("all tests, AVX2 alone but for onnxruntime", ("make", "test-avx2"))


def find_python(version: str) -> Path | None:
    """An interpreter of ``3.N``: that of this environment, in PATH, or pyenv's newest."""
    if version == f"{sys.version_info.major}.{sys.version_info.minor}":
        return Path(sys.executable)
    versions = Path.home() / ".pyenv" / "versions"
    pyenv = [path for path in versions.glob(f"{version}.*/bin/python") if path.is_file()]
    if pyenv:
        return max(pyenv, key=lambda path: [int(part) for part in path.parts[-3].split(".") if part.isdigit()])
    found = shutil.which(f"python{version}")
    return None if found is None else Path(found)


def environment(version: str, interpreter: Path) -> Path:
    """Python with what a robot has, what ``serve`` takes, and what the tests need; ttscompile as it is now."""
    folder = PLACE / version
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([interpreter, "-m", "venv", "--without-pip", folder], check=True)
    with tempfile.TemporaryDirectory() as name:
        source = source_copy(Path(name) / "source")
        known = ("-c", ROOT / "constraints.txt") if version in COMPILING else ()
        pip("--python", python, "install", *known, f"{source}[serve]", *BESIDE)
        pip("--python", python, "install", "--force-reinstall", "--no-deps", source)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "sitecustomize.py").write_text(CUSTOMIZE)
    return python


if __name__ == "__main__":
    sys.exit(main("--all" in sys.argv[1:]))
