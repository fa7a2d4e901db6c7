"""The commands on a layer of the Push-T policy: what they print is one JSON document, or tables that say the same."""

import json
import runpy
import shutil
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from tests.commands import as_json, done, refused
from tests.plans import store_schedules
from ttscompile.cli import main
from ttscompile.cli.bench import fewest_threads
from ttscompile.core.lattice import uniform_plan

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scheduled(compiled_layer: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact with a uniform schedule of 5 full steps as its default plan."""
    directory = tmp_path_factory.mktemp("scheduled") / "compiled"
    shutil.copytree(compiled_layer, directory)
    store_schedules(directory, None, {"uniform": uniform_plan(100, 3, 5)}, "uniform", {"learned": ["uniform"]})
    return directory


@pytest.fixture(scope="module")
def pruned(compiled_layer: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact with its untrained pruner as the default plan."""
    from ttscompile.artifact.load import load_artifact

    directory = tmp_path_factory.mktemp("pruned") / "compiled"
    shutil.copytree(compiled_layer, directory)
    weights = {name: np.array(array) for name, array in load_artifact(directory).pruner.items()}
    store_schedules(directory, weights, {}, "tts", {"learned": ["schedule"]})
    return directory


def test_help_has_a_whole_line_for_each_command_in_the_order_of_use(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["ttscompile", "--help"])
    monkeypatch.delitem(sys.modules, "ttscompile.__main__", raising=False)  # another test's
    with pytest.raises(SystemExit, match="0"):
        runpy.run_module("ttscompile", run_name="__main__")
    told = capsys.readouterr().out
    assert "Usage: python -m ttscompile" in told
    listed = [line.split(maxsplit=1) for line in told.partition("Commands:\n")[2].partition("\n\n")[0].splitlines()]
    assert {name for name, _ in listed} == set(main.commands)
    assert all(what.endswith((".", "?")) and not what.endswith("...") for _, what in listed), "cut off"
    assert [name for name, _ in listed][:4] == ["doctor", "build", "convert", "calibrate"]


def test_every_option_is_in_one_list_of_the_help_and_says_what_it_does() -> None:
    for name, command in main.commands.items():
        options = [one for one in command.params if isinstance(one, click.Option)]
        known = {one.name for one in options}
        for section in getattr(command, "sections", ()):
            assert {*section.options, *section.needs} <= known, f"{name}: {section.title}"
        told = done(name, "--help").stdout
        lines = [line.split() for line in told.splitlines() if line.startswith("  -")]
        for option in options:
            word = max(option.opts, key=len)
            assert sum(word in (one.rstrip(",") for one in line[:2]) for line in lines) == 1, f"{name} {word}"
            first = (option.help or "").partition(" ")[0]
            assert first[:1].isupper() and first not in ("Of", "In", "To", "Its"), f"{name} {word}: {option.help}"


def test_convert_says_what_it_made_and_explains_on_standard_error(one_layer_checkpoint: Path, tmp_path: Path) -> None:
    arguments = ("--sampler", "ddim", "--steps", "4", "--explain", "--json")
    result = done("convert", one_layer_checkpoint, "-o", tmp_path / "compiled", *arguments)
    made = json.loads(result.stdout)
    assert (made["sampler"]["name"], made["sampler"]["steps"]) == ("ddpm", 100)
    assert made["loops"]["ddim-4"] == {"sampler": "ddim", "steps": 4}
    assert made["plans"][made["default_plan"]]["loop"] == "ddim-4"
    assert len(made["blocks"]) == 3
    stages = [stage["stage"] for stage in made["stages"]]
    assert stages[0] == "capture"
    assert stages[-1] == "write"
    assert all(stage in result.stderr for stage in stages)
    del made["stages"]
    assert as_json("inspect", tmp_path / "compiled") == made


def test_inspect_accounts_for_every_flop(scheduled: Path) -> None:
    made = as_json("inspect", scheduled)
    flops, plans = made["flops"], made["plans"]
    assert flops["blocks"] == 100 * sum(block["flops"] for block in made["blocks"])
    assert plans["dense"]["flops"] == flops["prologue"] + flops["stems_and_tails"] + flops["blocks"]
    assert plans["dense"]["flops"] < flops["captured"], "hoisting left as much work as there was"
    assert made["default_plan"] == "uniform"
    assert plans["uniform"]["sparsity"] == pytest.approx(0.95)
    assert plans["uniform"]["flops"] == pytest.approx(plans["dense"]["flops"] - 0.95 * flops["blocks"])


def test_inspect_tells_the_same_in_tables(scheduled: Path) -> None:
    text = done("inspect", scheduled).stdout
    for expected in ("100 steps", "self_attention", "cross_attention", "feed_forward", "uniform (default)", "95.0%"):
        assert expected in text


def test_inspect_draws_the_default_plan(scheduled: Path, tmp_path: Path) -> None:
    as_json("inspect", scheduled, "-o", tmp_path / "plan.png")
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_a_pruners_plan_needs_an_observation(pruned: Path, tmp_path: Path) -> None:
    picture = tmp_path / "plan.png"
    assert "Add --trajectories FILE" in refused("inspect", pruned, "-o", picture)
    assert not picture.exists()
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "calls.npz", obs=rng.uniform(100, 400, (2, 2, 20)).astype(np.float32), episode_ends=[2])
    done("inspect", pruned, "-o", picture, "-t", tmp_path / "calls.npz")
    assert picture.exists()


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"state": np.zeros((2, 2, 20), np.float32), "episode_ends": [2]}, "has no array 'obs'"),
        ({"obs": np.zeros((0, 2, 20), np.float32), "episode_ends": [0]}, "the first of them above 0"),
    ],
)
def test_an_observation_that_does_not_fit(arrays: dict[str, Any], reason: str, pruned: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "calls.npz", **arrays)
    assert reason in refused("inspect", pruned, "-o", tmp_path / "plan.png", "-t", tmp_path / "calls.npz")


def test_a_plan_that_is_not_there_is_named_beside_those_that_are(scheduled: Path, tmp_path: Path) -> None:
    told = refused("inspect", scheduled, "-o", tmp_path / "plan.png", "--plan", "best")
    assert "has no plan 'best'; it has ['dense', 'uniform']" in told


def test_bench_times_everybody_on_the_same_calls(scheduled: Path, one_layer_checkpoint: Path) -> None:
    made = as_json("bench", scheduled, "--calls", 2, "--checkpoint", one_layer_checkpoint)
    assert made["machine"]["cores"] >= 1
    original, dense, compiled = made["contestants"]
    assert [c["label"] for c in made["contestants"]] == ["original, ddpm 100", "dense", "uniform (baseline)"]
    assert [len(c["times_ms"]) for c in (original, dense, compiled)] == [2, 2, 2]
    assert compiled["plan"] == "uniform"
    assert compiled["sparsity"] == pytest.approx(0.95)
    assert dense["sparsity"] == 0
    assert compiled["flops"] < dense["flops"] < original["flops"]


def test_bench_times_several_numbers_of_threads_and_takes_the_fewest_that_are_worth_it(scheduled: Path) -> None:
    arguments = ("--calls", 2, "--threads", "2,1,2")
    made = as_json("bench", scheduled, *arguments)
    assert [one["label"] for one in made["contestants"]] == [
        "dense, 2 threads",
        "uniform (baseline), 2 threads",
        "dense, 1 thread",
        "uniform (baseline), 1 thread",
    ]
    assert made["threads"] == [2, 1] and made["best_threads"] in (1, 2)
    assert "Load it with threads=" in done("bench", scheduled, *arguments).stdout
    assert "Load it with threads=" not in done("bench", scheduled, "--calls", 1).stdout
    assert fewest_threads({4: 9.0, 2: 9.9, 1: 12.0}) == 2
    assert fewest_threads({4: 8.0, 2: 9.9, 1: 12.0}) == 4


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--threads", "1,x"), "'x' is not a valid integer"),
        (("--threads", "2,0"), "0 is not in the range 1<=x<="),
        (("--threads", ""), "'' is not a valid integer"),
        (("--threads", "1,2", "--runtime", "torch"), "give --threads one number"),
    ],
)
def test_threads_that_bench_cannot_time(arguments: tuple[str, ...], told: str, scheduled: Path) -> None:
    assert told in refused("bench", scheduled, *arguments)


def test_bench_prints_a_table_and_warns_of_a_dense_artifact(compiled_layer: Path) -> None:
    result = done("bench", compiled_layer, "--calls", 1)
    assert "dense (default)" in result.stdout
    assert "is not calibrated" in result.stderr
