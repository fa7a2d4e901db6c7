"""Make a release, and try it as its users will: ``make release``, or

    python tests/release.py dist [v1.2.3]

ends at once if a tag is given that is not this version's, or the changelog has no section for it. Otherwise it builds
the sdist and, from that, the wheel; holds the wheel against the tree; lets twine check both; installs each into an
empty environment with what it asks for; and lets an artifact that is compiled here run there. Nothing is uploaded.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))

from tests.imports import PACKAGES  # noqa: E402
from ttscompile.measure.versions import VERSION  # noqa: E402

HOMES = {folder: package.replace(".", "/") for folder, package in PACKAGES.items()}
"""Folder of the tree -> where it is installed."""
BESIDE = ("CHANGELOG.md", "LICENSE", "MANIFEST.in", "README.md", "pyproject.toml")
CALLS = """
import sys, numpy, ttscompile
from importlib.metadata import version
assert version("ttscompile") == ttscompile.__version__ == sys.argv[2], ttscompile.__version__
policy = ttscompile.load(sys.argv[1], seed=0)
obs = {key: numpy.zeros((1, *spec.shape), spec.dtype) for key, spec in policy.info.observation.items()}
assert numpy.isfinite(policy.predict_action(obs)["action"]).all()
assert "torch" not in sys.modules
print(ttscompile.__file__)
"""


def build(out: Path, *, isolated: bool = True) -> tuple[Path, Path]:
    """Sdist and wheel of a copy of the tree, so that nothing that lies about in it gets in.

    Args:
        out: folder for both.
        isolated: build in an environment of its own, with setuptools from the index.
    """
    with tempfile.TemporaryDirectory() as scratch:
        tree = Path(scratch, "tree")
        for name in HOMES:
            shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in BESIDE:
            shutil.copy(ROOT / name, tree / name)
        options = [] if isolated else ["--no-isolation"]
        run([sys.executable, "-m", "build", *options, "--outdir", str(out), str(tree)])
    stem = out / f"ttscompile-{VERSION}"
    return Path(f"{stem}.tar.gz"), Path(f"{stem}-py3-none-any.whl")


def missing_or_more(wheel: Path) -> set[str]:
    """Files of the package that are in the tree and not in the wheel, or the other way round."""
    tree = {
        f"{HOMES[top]}/{path.relative_to(ROOT / top).as_posix()}"
        for top in HOMES
        for path in (ROOT / top).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    with zipfile.ZipFile(wheel) as opened:
        packed = {name for name in opened.namelist() if ".dist-info/" not in name}
    return tree ^ packed


def check(files: Sequence[Path]) -> None:
    """What the index would refuse, or show wrongly."""
    run([sys.executable, "-m", "twine", "check", "--strict", *map(str, files)])


def install_and_call(file: Path, artifact: Path, folder: Path) -> None:
    """Install a file into an empty environment, and let an artifact run there."""
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / "bin" / "python"
    run([str(python), "-m", "pip", "install", "--quiet", "-c", str(ROOT / "constraints.txt"), str(file)])
    run([str(python), "-c", CALLS, str(artifact), VERSION], cwd=folder)
    run([str(python.with_name("ttscompile")), "inspect", str(artifact)], cwd=folder)
    shutil.rmtree(folder / "venv")


def changes(version: str) -> str:
    """What the changelog says of a version; empty if it has no such heading with a date."""
    text = (ROOT / "CHANGELOG.md").read_text()
    found = re.search(
        rf"^## {re.escape(version)} - \d{{4}}-\d\d-\d\d\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL
    )
    return found[1].strip() if found else ""


def not_ready(tag: str | None, version: str = VERSION) -> str | None:
    """Why a version cannot be released under a tag, or untagged; None if it can."""
    if tag not in (None, f"v{version}"):
        return f"the tag is {tag}, and VERSION in ttscompile/measure/versions.py says {version}. Expected v{version}."
    if not changes(version):
        return f"CHANGELOG.md has no section '## {version} - DATE'. Write it, or change VERSION."
    return None


def project() -> dict[str, Any]:
    """The table ``project`` of pyproject.toml."""
    table: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return table


def run(words: list[str], cwd: Path | None = None) -> str:
    """What a command prints; RuntimeError with all that it said if it fails."""
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)[:300]}\n{done.stdout}{done.stderr}")
    return done.stdout


def main(out: Path, tag: str | None = None) -> None:
    """Make and try a release."""
    if (why := not_ready(tag)) is not None:
        sys.exit(f"error: {why}")
    from tests.runtimes.toys import toy_program, written_artifact

    out.mkdir(parents=True, exist_ok=True)
    files = build(out)
    if wrong := missing_or_more(files[1]):
        sys.exit(f"error: tree and wheel differ: {sorted(wrong)[:5]}. See packages in pyproject.toml.")
    check(files)
    with tempfile.TemporaryDirectory() as scratch:
        artifact = written_artifact(toy_program(), Path(scratch, "artifact")).path
        for file in files:
            install_and_call(file, artifact, Path(scratch))
            print(f"{file}: installs, and runs an artifact, in an empty environment")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "dist"), *sys.argv[2:3])
