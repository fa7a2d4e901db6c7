"""Calls and their parts on several numbers of threads; products in eight bits; memory of a policy that answers."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, process_time

import integer_products
import large_threads
import memory
import numpy as np
import parts
import pytest
import torch
import waiting
from click.testing import CliRunner
from large_smolvla import call
from rate import ProductRate

from tests.families import cameras
from tests.once import Once
from ttscompile import load
from ttscompile.artifact.load import load_artifact


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    """Torch has as many threads as before."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def compiled(once: Once, folder: Path) -> Path:
    """A folder with an artifact, as ``large.py`` leaves it."""
    (folder / "compiled").symlink_to(cameras.compiled_tokens(once) / "artifact")
    return folder


def test_what_was_timed_alone_is_known_by_its_threads(tmp_path: Path) -> None:
    def calls(threads: int) -> large_threads.Call:
        seconds = iter([9.0, 1.0, 5.0, 3.0])
        return lambda: (np.full(2, 4.0), [next(seconds) / threads, 0.5])

    assert large_threads.known(tmp_path, "eager") is None
    large_threads.alone(tmp_path, "eager", calls, (1, 2), rounds=3)
    found = large_threads.known(tmp_path, "eager")
    assert found is not None and torch.get_num_threads() == 2
    assert found()[0].tolist() == [4, 4] and found()[1] == [1.5, 0.5]
    torch.set_num_threads(1)
    assert found()[1] == [3.0, 0.5]


@pytest.mark.slow
@pytest.mark.parametrize("before", [False, True])
def test_all_contestants_are_in_one_table(
    once: Once, tmp_path: Path, capsys: pytest.CaptureFixture[str], before: bool
) -> None:
    folder = compiled(once, tmp_path)
    spec = load_artifact(folder / "compiled").manifest.spec
    if before:
        clock = large_threads.clock_of((1, 2))
        large_threads.alone(folder, "fp32", large_threads.exact_calls(folder, clock), (1, 2), rounds=1)
        own, (obs, noise) = large_threads.known(folder, "fp32"), call(spec)
        exact = load(folder / "compiled", plan="dense").predict_action(obs, noise=noise)["action"]
        assert own is not None and np.array_equal(own()[0], exact)
    asked = list[int]()

    def eager() -> tuple[np.ndarray, list[float]]:
        asked.append(torch.get_num_threads())
        return np.zeros(1), [4.0 / asked[-1], 2.0]

    capsys.readouterr()
    large_threads.compare(folder, "all, of it", eager, spec, 2, (1, 2), rounds=1)
    assert asked == [1, 1, 2, 2]
    printed = capsys.readouterr().out.splitlines()
    assert sum("for a processor" in line for line in printed) == 2
    head, _, *rows = (line for line in printed if line.startswith("|"))
    assert head == "| seconds a call | 1 thread | 2 threads | 2 of 1 |"
    names = ["eager: all, of it", *(f"{name}: prologue, loop" for name in ("dense, fp32", "dense, int8"))]
    named = [row.split(" | ")[0].removeprefix("| ") for row in rows]
    assert sorted(named) == sorted([*names, "2 of 3 steps, int8: prologue, loop"])
    assert rows[0] == "| eager: all, of it | 6.00 (4.00, 2.00) | 4.00 (2.00, 2.00) | 0.67 |"


def test_it_is_told_for_how_much_of_their_time_threads_waited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(thread: str, ran: int, waited: int) -> None:
        (tmp_path / thread).mkdir(exist_ok=True)
        (tmp_path / thread / "schedstat").write_text(f"{ran} {waited} 7\n")

    monkeypatch.setattr(waiting, "TASKS", tmp_path)
    write("1", 1000, 500)
    told = waiting.from_now_on()
    assert told() == "threads waited an unknown part of their time for a processor"
    write("1", 1600, 600)
    write("2", 100, 200)  # it began since
    assert told() == "threads waited 30% of their time for a processor"


def test_one_thread_is_timed_by_the_processor() -> None:
    assert large_threads.clock_of((1,)) is process_time
    assert large_threads.clock_of((2,)) is large_threads.clock_of((1, 2)) is perf_counter


def test_each_piece_of_a_call_and_its_operations_are_timed(once: Once) -> None:
    artifact = str(cameras.compiled_tokens(once) / "artifact")
    done = CliRunner().invoke(parts.main, [artifact, "--rounds", "1", "--operations"])
    assert done.exit_code == 0, done.output
    head, _, *rows = done.output.splitlines()
    assert head == "| ms | 1 | 2 | 2 of 1 |"
    named = [row.split(" | ")[0].removeprefix("| ") for row in rows]
    pieces = [name for name in named if not name.startswith("&nbsp;")]
    frames = [f"frame_00{more}" for more in ("", ", two frames", ", two frames at once")]
    assert pieces == [*frames, "condition", "dense_step", "advance"]
    assert "&nbsp; DynamicQuantizeMatMul" in named[3 : named.index("condition")]


def test_products_in_all_ways_are_near_the_exact_one() -> None:
    product = ProductRate("int8")
    product.run()
    matrix = np.random.default_rng(0).standard_normal((64, 128), np.float32)
    found = integer_products.measured(matrix, 3, 1, product)
    assert list(found) == list(integer_products.WAYS) and min(found.values()) > 0
    kinds = ["DynamicQuantizeLinear", *["MatMulIntegerToFloat"] * 2]
    assert [node.op_type for node in integer_products.halved(matrix, matrix[0], 3)[0][:3]] == kinds


@pytest.mark.skipif(not memory.ROLLUP.exists(), reason="needs /proc/self/smaps_rollup")
def test_a_policy_that_answers_takes_memory(once: Once) -> None:
    command = [sys.executable, memory.__file__, str(cameras.compiled_tokens(once) / "artifact")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 2**20  # this process may have it already
