"""The C++ example: built and run where there are a compiler and onnxruntime's headers."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

from tests.lower.whole_call import Episode, groups, inputs, make
from tests.runtimes.plans import random_plan, random_reading
from tests.runtimes.pruners import random_pruner
from tests.runtimes.toys import toy_program
from ttscompile.artifact import load_artifact
from ttscompile.core.correction import Correction, no_correction
from ttscompile.core.lattice import Source
from ttscompile.measure import machine
from ttscompile.runtimes.onnxruntime.sessions import EXACT_INTEGERS

SOURCE = Path(__file__).resolve().parents[2] / "examples" / "cpp" / "main.cpp"
CALLS = 5


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, linked against the library of Python's onnxruntime."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("NO C++ COMPILER: neither g++ nor clang++; the C++ example was not built")
    folder = tmp_path_factory.mktemp("cpp")
    header = subprocess.run([compiler, "-E", "-x", "c++", "-"], input="#include <onnxruntime_c_api.h>", text=True,
                            capture_output=True)  # fmt: skip
    if header.returncode != 0:
        pytest.skip("NO ONNXRUNTIME HEADERS: set CPATH to their folder (examples/cpp/README.md); example not built")
    libraries = list((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*.*.*"))
    if not libraries:
        pytest.skip("NO LIBONNXRUNTIME in Python's onnxruntime; the C++ example was not built")
    (folder / "libonnxruntime.so.1").symlink_to(libraries[0])
    flags = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror"]
    paths = [str(SOURCE), "-o", str(folder / "episode"), str(folder / "libonnxruntime.so.1"), f"-Wl,-rpath,{folder}"]
    subprocess.run([compiler, *flags, *paths], check=True)
    return folder / "episode"


@pytest.mark.parametrize("streams", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_an_episode_is_what_python_computes(program: Path, tmp_path: Path, streams: int, noise: float) -> None:
    toy = toy_program(steps=8, blocks=7, noise=noise)
    policy, model = make(toy, tmp_path)
    (tmp_path / "call.onnx").write_bytes(model)
    rng = np.random.default_rng(streams)
    episode, written, expected = Episode(model, streams), np.zeros((8, 7), np.bool_), []
    reads = np.zeros(4, int)
    feeds: dict[str, Any] = {}
    calibrated: dict[str, Any] = {"use_pruner": np.array(True), **random_pruner(toy, 0)}
    if streams == 2:  # of a calibrated schedule
        empty = no_correction(8, toy.spec.sample)
        weights, bias = (rng.normal(0, 0.01, each.shape).astype(np.float32) for each in (empty.weights, empty.bias))
        numbers = load_artifact(tmp_path / "artifact").manifest.condition_numbers
        feeds = Correction(np.arange(8) % 3 == 0, weights, bias, *random_reading(rng, numbers, empty)).inputs()
    for r in range(CALLS):
        plan = random_plan(rng, 8, groups(toy), written, 0.3)
        obs, drawn = inputs(policy, rng, streams)
        pruned: dict[str, Any] = calibrated if r % 2 else {}  # in every second call each stream has a plan of its own
        call = episode.call(obs, drawn, plan, **feeds, **pruned)
        expected.append(call["action"].ravel())
        written |= (call["executed_plan"] == Source.COMPUTE).all(axis=0)
        reads += np.bincount(call["executed_plan"].ravel(), minlength=4)
        given = {**obs, **feeds, **pruned, "initial_noise": drawn.initial, "plan": plan}
        given["rollout_keep"] = np.ones((8, 7), np.bool_)
        if drawn.steps is not None:
            given["step_noise"] = drawn.steps
        (tmp_path / str(r)).mkdir()
        for name, value in given.items():
            value.tofile(tmp_path / str(r) / f"{name}.bin")
    assert (reads > 0).all()
    command = [str(program), str(tmp_path / "call.onnx"), str(tmp_path), str(CALLS)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    found = np.array([[float(number) for number in line.split()] for line in result.stdout.splitlines()])
    np.testing.assert_allclose(found, np.stack(expected), rtol=1e-6)
    assert re.fullmatch(r"(call \d: [\d.]+ ms\n){5}", result.stderr)


def test_it_looks_for_the_processors_that_python_looks_for() -> None:
    """Those on which sums of eight-bit products are exact without the option."""
    source = SOURCE.read_text()
    assert set(re.findall(r'word == "(\w+)"', source)) == set(machine._DOT_PRODUCTS)
    assert (
        f'if (!has_integer_dot_product()) check(ort->AddSessionConfigEntry(options, "{EXACT_INTEGERS}", "1"));'
        in source
    )


def test_what_is_wrong_is_said(program: Path, tmp_path: Path) -> None:
    _, model = make(toy_program(), tmp_path)
    (tmp_path / "call.onnx").write_bytes(model)
    result = subprocess.run(
        [str(program), str(tmp_path / "call.onnx"), str(tmp_path), "1"], capture_output=True, text=True
    )
    assert result.returncode == 1
    assert "cannot read" in result.stderr
    assert subprocess.run([str(program)], capture_output=True).returncode == 2
