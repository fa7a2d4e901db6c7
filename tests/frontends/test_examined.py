"""Checkpoints that convert and then fail on a robot: what is said of their statistics, cameras and tokenizers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from ttscompile import Affine, ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.core.finding import Finding, Level
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.examined import examine

from ..calibration import policies
from ..policies.lerobot_tiny import DA, DS, change_json, save_policy, write_json

STATE, ACTION, FRONT = "observation.state", "action", "observation.images.front"
Tensors = dict[str, torch.Tensor]


def found(directory: Path) -> dict[str, Finding]:
    """By what, all that is said."""
    return {one.what: one for one in examine(directory, load_checkpoint_policy(directory)[1])}


def statistics(directory: Path, change: Callable[[Tensors], object], file: str = "before") -> Path:
    path = directory / f"{file}.safetensors"
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)
    return directory


def varying(tensors: Tensors) -> None:
    """No channel stands still, which the last one of the tiny policies does."""
    for key, width in ((STATE, DS), (ACTION, DA)):
        tensors |= {f"{key}.min": torch.zeros(width), f"{key}.max": torch.full((width,), 3.0)}
        tensors |= {f"{key}.mean": torch.ones(width), f"{key}.std": torch.full((width,), 2.0)}


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    return statistics(statistics(save_policy(tmp_path, ("front",)), varying), varying, "after")


def test_a_sound_checkpoint_has_no_warning_and_says_what_it_takes(sound: Path) -> None:
    said = found(sound)
    assert not [one for one in said.values() if one.remedy]
    assert said["cameras"].found == f"1, in this order: {FRONT} [2, 3, 24, 24]"
    assert said["action"].found == f"{DA} numbers; 4 of 8 predicted steps are executed"


@pytest.mark.parametrize(
    ("change", "level", "told"),
    [
        (lambda t: t.update({f"{STATE}.max": torch.full((DS,), -3.0)}), Level.PROBLEM, "inverted"),
        (lambda t: t.update({f"{STATE}.max": torch.zeros(DS)}), Level.PROBLEM, "inert: its range is 0 everywhere"),
        (lambda t: t[f"{STATE}.max"].__setitem__(2, 0), Level.WARNING, "0 in column 2 of 5"),
        (
            lambda t: t.update({f"{STATE}.min": -torch.ones(DS), f"{STATE}.max": torch.ones(DS)}),
            Level.WARNING,
            "the identity",
        ),
        (lambda t: [t.pop(f"{STATE}.{n}") for n in ("min", "max", "mean", "std", "q01", "q99", "q10", "q90")],
         Level.PROBLEM, "no statistics of observation.state"),
    ],
)  # fmt: skip
def test_statistics_that_do_nothing_or_harm(
    sound: Path, change: Callable[[Tensors], object], level: Level, told: str
) -> None:
    one = found(statistics(sound, change))[f"normaliser of {STATE}"]
    assert one.level is level and told in one.found and one.remedy


@pytest.mark.parametrize(
    ("mode", "values", "told"),
    [
        ("MEAN_STD", {"mean": (0, 1), "std": (2, 0)}, "its deviation is 0 in column 1 of 5"),
        ("QUANTILES", {"q01": (0, 1), "q99": (3, 1)}, "its range is 0 in column 1 of 5"),
        ("QUANTILES", {"q01": (0, 1), "q99": (3, 0.5)}, "inverted: its range is below zero in column 1 of 5"),
    ],
)
def test_deviations_and_quantiles_are_looked_at_too(
    tmp_path: Path, mode: str, values: dict[str, tuple[float, float]], told: str
) -> None:
    """Each of column 1, and of the others."""

    def change(tensors: Tensors) -> None:
        for name, (others, one) in values.items():
            tensors[f"{STATE}.{name}"] = torch.where(torch.arange(DS) == 1, float(one), float(others))

    directory = statistics(save_policy(tmp_path, modes=("IDENTITY", mode, mode)), change)
    assert found(directory)[f"normaliser of {STATE}"].found.startswith(told)


def test_an_action_that_never_changed_is_worth_a_note(tmp_path: Path) -> None:
    one = found(save_policy(tmp_path))[f"normaliser of {ACTION}"]
    assert one.level is Level.NOTE and "column 2 of 3" in one.found


def test_state_without_a_normaliser_is_a_warning(tmp_path: Path) -> None:
    directory = save_policy(tmp_path, modes=("IDENTITY", "IDENTITY", "MIN_MAX"))
    one = found(directory)[f"normaliser of {STATE}"]
    assert one.level is Level.WARNING and one.found.startswith("there are statistics, and IDENTITY is configured")

    def without(tensors: Tensors) -> None:
        for name in [name for name in tensors if name.startswith(STATE)]:
            del tensors[name]

    one = found(statistics(directory, without))[f"normaliser of {STATE}"]
    assert one.level is Level.WARNING and one.found.startswith("there are no statistics of observation.state")


def test_pictures_without_a_normaliser_are_usual(tmp_path: Path) -> None:
    """Whether or not there are statistics of them: SmolVLA sees so."""
    kept = list[bool]()
    directory = save_policy(tmp_path, ("front",), modes=("IDENTITY", "MIN_MAX", "MIN_MAX"))
    said = found(statistics(directory, lambda tensors: kept.append(f"{FRONT}.mean" in tensors)))
    assert kept == [True] and f"normaliser of {FRONT}" not in said and f"normaliser of {STATE}" in said


def test_cameras_of_the_data_that_the_policy_does_not_read(sound: Path) -> None:
    def rename(tensors: Tensors) -> None:
        for name in [name for name in tensors if name.startswith(FRONT)]:
            tensors[name.replace("front", "top")] = tensors.pop(name)

    directory = statistics(sound, rename)
    change_json(directory / "policy_preprocessor.json", **_without_visual(directory))
    one = found(directory)["names of cameras"]
    assert one.level is Level.WARNING
    assert "the data had observation.images.top, which the policy does not read; it reads " + FRONT in one.found
    assert f'{{"observation.images.top": "{FRONT}"}}' in one.remedy


def _without_visual(directory: Path) -> dict[str, object]:
    steps = json.loads((directory / "policy_preprocessor.json").read_text())["steps"]
    steps[-1]["config"]["norm_map"]["VISUAL"] = "IDENTITY"
    return {"steps": steps}


def test_pictures_of_another_size_than_those_of_the_statistics(sound: Path) -> None:
    steps = json.loads((sound / "policy_preprocessor.json").read_text())["steps"]
    steps[-1]["config"]["features"][FRONT]["shape"] = [3, 48, 24]
    change_json(sound / "policy_preprocessor.json", steps=steps)
    assert found(sound)[f"size of {FRONT}"].found.startswith("[3, 24, 24] in config.json, and [3, 48, 24] in the data")


def test_more_steps_to_execute_than_are_predicted(sound: Path) -> None:
    change_json(sound / "config.json", n_action_steps=8)
    one = found(sound)["chunk"]
    assert "n_action_steps is 8, and only 7" in one.found and "Set it to 7" in one.remedy


def test_a_call_at_every_step_is_a_warning(sound: Path) -> None:
    change_json(sound / "config.json", n_action_steps=1)
    assert found(sound)["action"].level is Level.WARNING


@pytest.mark.parametrize(("words", "level"), [(19, Level.OK), (30, Level.PROBLEM)])
def test_a_tokenizer_has_no_more_tokens_than_the_model_knows(sound: Path, words: int, level: Level) -> None:
    model = {"type": "WordLevel", "vocab": {f"w{n}": n for n in range(words)}, "unk_token": "w0"}
    write_json(sound / "tokenizer.json", {"version": "1.0", "added_tokens": [], "model": model})
    one = found(sound)["tokenizer"]
    assert one.level is level and f"{words} tokens; 20 are known" in one.found


def test_affine_normalisers_are_judged_alike(tmp_path: Path) -> None:
    """Of Diffusion Policy, whose specification says all."""
    ones = np.ones(2, np.float32)
    chunk = ChunkSpec(2, 1, 5, Affine(-ones, 0 * ones))
    spec = PolicySpec((8, 2), {"obs": ObservationSpec((2, 2), Affine(ones, 0 * ones))}, policies.spec().sampler, chunk)
    said = {one.what: one for one in examine(tmp_path, spec)}
    assert "identity" in said["normaliser of obs"].found
    assert "inverted" in said["normaliser of action"].found
