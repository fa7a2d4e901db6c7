"""The rows of the policy families: each can be loaded, and options reach it from the command line and from Python."""

import inspect
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
import pytest

import ttscompile
from ttscompile.cli import main
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends.families import FAMILIES, FORMATS, SAMPLERS, Family, LoadOptions, find_family

OPTIONS = {field.name for field in fields(LoadOptions)}


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_a_row_has_its_module_and_takes_options_that_there_are(family: Family) -> None:
    assert len(inspect.signature(family.function("load")).parameters) == 2
    assert family.options <= OPTIONS
    assert family.reads.split()[0] in ("a", "an")


def test_names_are_there_once_and_every_option_has_a_taker() -> None:
    assert len(set(FORMATS)) == len(FORMATS) == len(FAMILIES) + 1
    assert frozenset.union(*(family.options for family in FAMILIES)) == OPTIONS


def test_options_are_the_arguments_of_convert_and_of_the_command_line() -> None:
    assert set(inspect.signature(ttscompile.convert).parameters) > OPTIONS
    shown = {each.name: each.type for each in main.commands["convert"].params}
    assert set(shown) > OPTIONS - {"loops", "spacing"}, "of the Python interface alone"
    for name, choices in {"sampler": SAMPLERS}.items():
        kind = shown[name]
        assert isinstance(kind, click.Choice) and tuple(kind.choices) == choices


@pytest.mark.parametrize("option", sorted(OPTIONS))
def test_an_option_of_other_families_is_refused_before_anything_is_loaded(option: str, tmp_path: Path) -> None:
    own = Family("own", "our own", "a file", lambda path: True, "there_is_no_such_module", frozenset())
    given: dict[str, Any] = {option: 7 if option in ("steps", "prediction_horizon") else "x"}
    with pytest.raises(CheckpointError, match=rf"the option {option} is for policies of .*; this is one of our own"):
        own.load(tmp_path / "policy", LoadOptions(**given))


@pytest.mark.parametrize("task", ["push\n", "push\tit", "\x1b[31mpush", "push\u202e"])
def test_a_task_that_no_artifact_keeps_is_refused_before_anything_is_loaded(task: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="has the character .*, which a terminal does not show"):
        ttscompile.convert(tmp_path / "policy", tmp_path / "compiled", task=task)


def test_the_narrower_family_is_asked_first(tmp_path: Path) -> None:
    assert find_family(tmp_path / "policy.ckpt", "auto").name == "diffusion_policy"
    (tmp_path / "config.json").write_text('{"type": "act"}')
    assert find_family(tmp_path, "auto").name == find_family(tmp_path, "lerobot").name == "lerobot"
    with pytest.raises(CheckpointError, match="is a directory without a policy that is read"):
        find_family(tmp_path, "diffusion_policy")
    with pytest.raises(
        CheckpointError, match="no such file or directory; expected a directory that lerobot's save_pretrained"
    ):
        find_family(tmp_path / "nowhere", "lerobot")
    with pytest.raises(CheckpointError, match=r"config\.json: not of the format lerobot; expected a directory that"):
        find_family(tmp_path / "config.json", "lerobot")
    (tmp_path / "adapter_config.json").touch()
    assert find_family(tmp_path, "auto").name == "lerobot"
    (tmp_path / "config.json").unlink()
    with pytest.raises(CheckpointError, match=r"a PEFT adapter without the config\.json .*told by adapter_c.*Merge it"):
        find_family(tmp_path, "auto")


def test_the_rows_can_be_read_without_torch() -> None:
    code = "import sys; sys.modules['torch'] = None; from ttscompile.frontends.families import FORMATS; print(*FORMATS)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert result.stdout.split() == list(FORMATS)
