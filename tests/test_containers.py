"""The container files hold together with the tree; ``make containers`` builds and runs them, where that can be done."""

from __future__ import annotations

import re
import tomllib

import pytest

from ttscompile.cli import main

from . import containers, release

ROOT = containers.ROOT
FILES = {image: ROOT / "containers" / f"{image}.Dockerfile" for image in containers.IMAGES}


def instructions(image: str) -> list[tuple[str, str]]:
    """Instruction and the rest, continued lines joined."""
    text = re.sub(r"\\\n\s*", "", FILES[image].read_text())
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [(line.partition(" ")[0], line.partition(" ")[2]) for line in lines]


@pytest.mark.parametrize("image", containers.IMAGES)
def test_what_is_copied_is_what_the_package_is_built_of(image: str) -> None:
    copied = [rest.split()[:-1] for word, rest in instructions(image) if word == "COPY" and "--from" not in rest]
    names = {name for each in copied for name in each}
    assert names == {*release.HOMES, *release.BESIDE, "constraints.txt"}
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert ignored[1] == "*" and {line[1:] for line in ignored if line.startswith("!")} == names


@pytest.mark.parametrize("image", containers.IMAGES)
def test_the_package_is_installed_with_extras_that_there_are_and_pinned(image: str) -> None:
    installs = [rest for word, rest in instructions(image) if word == "RUN" and "pip install" in rest]
    assert len(installs) == 1 and "-c constraints.txt" in installs[0] and "--no-cache-dir" in installs[0]
    found = re.search(r"'\.\[([\w,]+)\]'", installs[0])
    assert found is not None
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(found[1].split(",")) <= set(project["optional-dependencies"])
    assert ("compile" in found[1]) == (image == "compile"), "a robot has no torch"


@pytest.mark.parametrize("image", containers.IMAGES)
def test_a_container_runs_the_command_and_not_as_root(image: str) -> None:
    last = dict(instructions(image))  # of each instruction the last one counts
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert last["ENTRYPOINT"] == '["ttscompile"]' and "ttscompile" in project["scripts"]
    assert last["CMD"].strip('[]"') in main.commands
    made = [rest for word, rest in instructions(image) if word == "RUN" and "useradd" in rest]
    assert made[-1].endswith(f"--create-home {last['USER']}")
    order = [word for word, _ in instructions(image)]
    assert len(order) - order[::-1].index("RUN") <= order.index("USER"), "nothing is run as that user while it is built"


def test_without_docker_and_buildah_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(RuntimeError, match="apt-get install buildah"):
        containers.tool()
