"""A robot's processor, emulated: the runtime on 64-bit ARM, held to what x86 computes. Linux on x86, no rights of root.

    python tests/machines/arm.py [--cpu cortex-a72 ...] [-- PYTEST OPTIONS]

Builds in ``build/arm``: a folder with Debian's arm64 packages of Python 3.11, unpacked; aarch64 wheels of numpy,
onnxruntime and what the tests need; this package without its extras. Then ``made.py`` makes artifacts here, and
``robot.py`` runs under ``qemu-aarch64-static``. What is there already is used again; ``rm -r build/arm`` begins anew.
Times mean nothing under emulation, and none is measured.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))

from tests.source import source_copy  # noqa: E402

PLACE = ROOT / "build" / "arm"
QEMU, KEYS = "qemu-aarch64-static", Path("/usr/share/keyrings/debian-archive-keyring.gpg")
NEEDED = {QEMU: "qemu-user-static", "apt-get": "apt", "dpkg-deb": "dpkg"}
MIRROR, RELEASE, PYTHON = "http://deb.debian.org/debian", "bookworm", "python3.11"
DEBIAN = (PYTHON, "libstdc++6")
PACKAGES = ("numpy", "onnxruntime", "click", "rich", "websockets", "pytest", "pytest-benchmark", "hypothesis")
PLATFORMS = ("manylinux2014_aarch64", "manylinux_2_27_aarch64", "manylinux_2_28_aarch64")
PROCESSORS = {
    "cortex-a72": ("0xd08", "fp asimd evtstrm crc32 cpuid"),  # Raspberry Pi 4
    "cortex-a76": (  # Raspberry Pi 5; the Cortex-A78AE of Jetson Orin has these too
        "0xd0b",
        "fp asimd evtstrm aes pmull sha1 sha2 crc32 atomics fphp asimdhp cpuid asimdrdm lrcpc dcpop asimddp",
    ),
}
"""QEMU's name of a processor -> its part and features in ``/proc/cpuinfo``. The second has dot products of eight-bit
integers, the first has none, and onnxruntime has other kernels for each."""

# Python's own children run in the emulator as well: they are started by the name of the script that started it.
CUSTOMIZE = """import os, sys
if "EMULATED_PYTHON" in os.environ:
    sys.executable = sys._base_executable = os.environ["EMULATED_PYTHON"]
"""


def main(processors: Sequence[str], options: Sequence[str]) -> int:
    """Build what is not there, and run ``robot.py`` on each processor; 0 if everything passed on all."""
    if lacking := [package for program, package in NEEDED.items() if shutil.which(program) is None]:
        print(f"found no {', '.join(lacking)}. Run: sudo apt-get install {' '.join(lacking)} debian-archive-keyring.")
        return 2
    root, made = PLACE / "root", PLACE / "made"
    once(root, build_root)
    install(root)
    if not made.exists():
        subprocess.run([sys.executable, ROOT / "tests/machines/made.py", made], check=True)
    failed = []
    for processor in processors:
        print(f"\n{processor}, emulated by {QEMU}", flush=True)
        python = emulated_python(root, processor)
        if subprocess.run([python, ROOT / "tests/machines/robot.py", made, *options], check=False).returncode:
            failed.append(processor)
    print(f"\n{'FAILED on ' + ', '.join(failed) if failed else 'passed on ' + ', '.join(processors)}")
    return int(bool(failed))


def once(folder: Path, build: Callable[[Path], None]) -> None:
    """Build a folder beside its name and rename it, unless it is there."""
    if not folder.exists():
        unfinished = folder.with_name(f"{folder.name}.unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        build(unfinished)
        unfinished.rename(folder)


def build_root(root: Path) -> None:
    """Download Debian's packages for arm64, which apt resolves with a state of its own, and unpack them."""
    with tempfile.TemporaryDirectory() as name:
        apt = Path(name)
        (apt / "status").touch()
        (apt / "sources").write_text(f"deb [arch=arm64 signed-by={KEYS}] {MIRROR} {RELEASE} main\n")
        for folder in ("state/lists/partial", "cache/archives/partial"):
            (apt / folder).mkdir(parents=True)
        settings = {
            "APT::Architecture": "arm64",
            "APT::Architectures": "arm64",
            "APT::Install-Recommends": "false",
            "APT::Sandbox::User": "root" if os.getuid() == 0 else "",
            "Debug::NoLocking": "true",
            "Dir::State": apt / "state",
            "Dir::State::status": apt / "status",
            "Dir::Cache": apt / "cache",
            "Dir::Etc::sourcelist": apt / "sources",
            "Dir::Etc::sourceparts": "/dev/null",
            "Dir::Etc::preferences": "/dev/null",
            "Dir::Etc::preferencesparts": "/dev/null",
        }
        command = ["apt-get", "-qq", *(word for each in settings.items() for word in ("-o", f"{each[0]}={each[1]}"))]
        subprocess.run([*command, "update"], check=True)
        subprocess.run([*command, "-y", "--download-only", "install", *DEBIAN], check=True, stdout=subprocess.DEVNULL)
        for package in sorted((apt / "cache/archives").glob("*.deb")):
            subprocess.run(["dpkg-deb", "-x", package, root], check=True)
    (root / "usr/lib" / PYTHON / "sitecustomize.py").unlink()
    (root / "usr/lib" / PYTHON / "sitecustomize.py").write_text(CUSTOMIZE)
    into = ["--target", root / "usr/lib/python3/dist-packages", "--python-version", "3.11", "--implementation", "cp"]
    platforms = [word for platform in PLATFORMS for word in ("--platform", platform)]
    pip("install", "-c", ROOT / "constraints.txt", *into, *platforms, "--only-binary=:all:", *PACKAGES)


def install(root: Path) -> None:
    """This package as it is now; it is Python alone, so that one wheel is for every processor."""
    with tempfile.TemporaryDirectory() as name:
        pip("wheel", "--no-deps", "--wheel-dir", name, source_copy(Path(name) / "source"))
        (wheel,) = Path(name).glob("*.whl")
        pip("install", "--upgrade", "--no-deps", "--target", root / "usr/lib/python3/dist-packages", wheel)


def pip(*words: object) -> None:
    """Pip of the Python that runs this."""
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*command, *map(str, words)], check=True)


def emulated_python(root: Path, processor: str) -> Path:
    """A program that is Python on a processor, for whoever starts one; the root then looks like that machine.

    QEMU takes files of the root where they exist, so ``/proc/cpuinfo`` too. Without it onnxruntime reads that of x86,
    and ends in a segmentation fault.
    """
    part, features = PROCESSORS[processor]
    fields = {
        "Features": features,
        "CPU implementer": "0x41",
        "CPU architecture": "8",
        "CPU variant": "0x0",
        "CPU part": part,
        "CPU revision": "3",
    }
    core = "".join(f"{name}\t: {value}\n" for name, value in fields.items())
    cores = "\n".join(f"processor\t: {i}\n{core}" for i in range(os.cpu_count() or 1))
    (root / "proc").mkdir(exist_ok=True)
    (root / "proc/cpuinfo").write_text(cores)
    script = root.parent / f"python-{processor}"
    return written_script(script, (QEMU, "-cpu", processor, "-L", root), root / "usr" / "bin" / PYTHON)


def written_script(script: Path, emulator: Sequence[object], python: Path) -> Path:
    """A program that starts Python in an emulator; ``CUSTOMIZE`` lets it know by which name."""
    words = [*emulator, "-E", f"EMULATED_PYTHON={script}", python]
    script.write_text(f'#!/bin/sh\nexec {shlex.join(map(str, words))} "$@"\n')
    script.chmod(0o755)
    return script


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Run the runtime on emulated ARM processors.")
    parser.add_argument("--cpu", nargs="+", choices=PROCESSORS, default=list(PROCESSORS))
    parser.add_argument("options", nargs="*", help="of pytest, after --")
    given = parser.parse_args()
    sys.exit(main(given.cpu, given.options))
