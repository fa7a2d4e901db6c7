"""Build both images, and let each do its work: ``make containers``, or

    python tests/containers.py [OPTIONS OF THE BUILD...]

with docker where its daemon answers, else with buildah, which needs none. The image for a robot loads and calls an
artifact that is compiled here; the one for compiling converts a small policy, and what it makes runs here.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))

IMAGES = ("robot", "compile")


def tool() -> str:
    """``docker`` or ``buildah``; RuntimeError without both."""
    if shutil.which("docker") and subprocess.run(["docker", "info"], capture_output=True).returncode == 0:
        return "docker"
    if shutil.which("buildah"):
        return "buildah"
    raise RuntimeError("no daemon of docker answers, and there is no buildah. Install one (apt-get install buildah).")


def build(image: str, options: list[str]) -> None:
    """Build an image, ``ttscompile-robot`` or ``ttscompile-compile``."""
    words = {"docker": ["docker", "build"], "buildah": ["buildah", "bud", "--isolation", "chroot"]}[tool()]
    file = ROOT / "containers" / f"{image}.Dockerfile"
    _run([*words, *options, "-f", str(file), "-t", f"ttscompile-{image}", str(ROOT)])


def run(image: str, folder: Path, *words: str, own: bool = False) -> str:
    """What a command prints in a container, with a folder of this machine as ``/work``.

    Args:
        image: ``robot`` or ``compile``.
        folder: on this machine.
        *words: the command.
        own: as the user who runs this, whose files are then readable and what is made is theirs.
    """
    shared = ["-v", f"{folder}:/work", *(["--user", f"{os.getuid()}:{os.getgid()}"] if own else [])]
    if tool() == "docker":
        return _run(["docker", "run", "--rm", *shared, "--entrypoint", words[0], f"ttscompile-{image}", *words[1:]])
    container = _run(["buildah", "from", "--pull-never", f"ttscompile-{image}"]).strip()
    try:
        return _run(["buildah", "run", "--isolation", "chroot", *shared, container, "--", *words])
    finally:
        _run(["buildah", "rm", container])


def _run(words: list[str]) -> str:
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)[:300]}\n{done.stdout[-2000:]}{done.stderr[-4000:]}")
    return done.stdout


def main(options: list[str]) -> None:
    """Build and try both."""
    import numpy as np

    import ttscompile
    from tests.policies.lerobot_tiny import save_policy
    from tests.release import CALLS
    from tests.runtimes.toys import toy_program, written_artifact
    from ttscompile.measure.versions import VERSION

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        folder.chmod(0o777)  # the container's user is another
        written_artifact(toy_program(), folder / "artifact")
        save_policy(folder)
        build("robot", options)
        print(run("robot", folder, "ttscompile", "doctor", "/work/artifact"))
        run("robot", folder, "python3", "-c", CALLS, "/work/artifact", VERSION)
        print("robot: an artifact that was made here runs there; the user is", run("robot", folder, "whoami"))
        build("compile", options)
        words = ("convert", "/work/policy", "--encoders", "/work/clip-small", "-o", "/work/made", "--steps", "2")
        run("compile", folder, "ttscompile", *words, own=True)
        policy = ttscompile.load(folder / "made", seed=0)
        obs = {key: np.zeros((1, *spec.shape), spec.dtype) for key, spec in policy.info.observation.items()}
        assert np.isfinite(policy.predict_action(obs)["action"]).all()
        print("compile: an artifact that was made there runs here")


if __name__ == "__main__":
    main(sys.argv[1:])
