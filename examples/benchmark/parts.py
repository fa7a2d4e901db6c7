"""What a second thread brings to each part of a call, and to the operations in it.

    python examples/benchmark/parts.py DIR [--plan dense@int8] [--threads 1,2] [--operations]

``DIR`` is an artifact; of what ``large.py --output DIR`` leaves it is ``DIR/compiled``. Each piece that a call with
whole steps runs is timed alone, by the clock, on random numbers: medians of calls in which numbers of threads take
turns. Pieces of one frame are timed for two frames, too, one after the other and at once: two callers of one session.
With ``--operations`` onnxruntime says what its operations take in each piece; ``Scan`` is attention.
"""

from __future__ import annotations

import json
import statistics
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import onnxruntime
from commands import numbers
from towers import by_operation

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import View, view_of
from ttscompile.ir.pieces import ADVANCE, CONDITION, DENSE_STEP, SCENE, STEP, frame_pieces
from ttscompile.runtimes.onnxruntime.sessions import SPIN_US, Sessions

Feeds = dict[str, npt.NDArray[Any]]

_TYPES: dict[str, Callable[[np.random.Generator, list[int]], npt.NDArray[Any]]] = {
    "tensor(float)": lambda draw, shape: draw.standard_normal(shape, np.float32),
    "tensor(uint8)": lambda draw, shape: draw.integers(0, 255, shape, np.uint8),
    "tensor(int64)": lambda draw, shape: draw.integers(0, 2, shape, np.int64),
    "tensor(bool)": lambda _, shape: np.ones(shape, np.bool_),
}
"""Random numbers of a type; of whole numbers such that a table has them, and all tokens count."""

LEAST = 0.01
"""Share of a piece's time from which an operation is listed."""


def feeds(session: onnxruntime.InferenceSession, draw: np.random.Generator) -> Feeds:
    """Random inputs for one stream."""
    return {each.name: _TYPES[each.type](draw, [_size(one) for one in each.shape]) for each in session.get_inputs()}


def _size(of: int | str) -> int:
    """Of one stream: that of ``B`` is 1, and that of ``4*B`` is 4."""
    return of if isinstance(of, int) else int("".join(filter(str.isdigit, of)) or 1)


def ways(
    view: View, piece: str, session: onnxruntime.InferenceSession, pool: ThreadPoolExecutor
) -> dict[str, Callable[[], object]]:
    """What is timed of a piece, by name."""
    draw = np.random.default_rng(0)
    first, second = feeds(session, draw), feeds(session, draw)

    def run(given: Feeds) -> object:
        return session.run(None, given)

    if piece not in frame_pieces(view.manifest.pieces):
        return {piece: lambda: run(first)}
    return {
        piece: lambda: run(first),
        f"{piece}, two frames": lambda: [run(first), run(second)],
        f"{piece}, two frames at once": lambda: list(pool.map(run, (first, second))),
    }


def timed(view: View, piece: str, sessions: list[dict[str, Any]], rounds: int) -> Mapping[str, list[float]]:
    """Milliseconds with the sessions of each number of threads, by what is timed."""
    with ThreadPoolExecutor(2) as pool:
        calls = [ways(view, piece, own[piece], pool) for own in sessions]
        found: dict[str, list[list[float]]] = {name: [[] for _ in sessions] for name in calls[0]}
        for _ in range(rounds + 1):  # the first does not count
            for own, times in zip(calls, zip(*found.values(), strict=True), strict=True):
                for call, taken in zip(own.values(), times, strict=True):
                    start = perf_counter()
                    call()
                    taken.append(1000 * (perf_counter() - start))
    return {name: [statistics.median(each[1:]) for each in own] for name, own in found.items()}


def operations(view: View, piece: str, threads: tuple[int, ...], rounds: int) -> list[str]:
    """A line for each operation of a piece that takes some of its time: milliseconds on each number of threads."""
    found = [_profiled(view, piece, count, rounds) for count in threads]
    whole, lines = found[0].total(), list[str]()
    for operation, first in found[0].most_common():
        if first >= LEAST * whole:
            taken = [each[operation] / 1000 for each in found]
            cells = " | ".join(f"{one:.1f}" for one in taken)
            lines.append(f"| &nbsp; {operation} | {cells} | {taken[-1] / taken[0]:.2f} |")
    return lines


def _profiled(view: View, piece: str, threads: int, rounds: int) -> Counter[str]:
    """Microseconds of a run, by operation."""
    with tempfile.TemporaryDirectory() as folder:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.add_session_config_entry("session.intra_op.spin_duration_us", str(SPIN_US))
        options.enable_profiling, options.profile_file_prefix = True, str(Path(folder) / "profile")
        file = view.artifact.files / view.onnx_file(piece)
        session = onnxruntime.InferenceSession(str(file), options, ["CPUExecutionProvider"])
        given = feeds(session, np.random.default_rng(0))
        for _ in range(rounds):
            session.run(None, given)
        took = by_operation(json.loads(Path(session.end_profiling()).read_bytes()))
    return Counter({operation: each // rounds for operation, each in took.items()})


@click.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.option("--plan", default="dense@int8", help="Whose pieces are timed.")
@click.option("--threads", default="1,2", callback=numbers, help="Numbers of them.")
@click.option("--rounds", default=7, type=click.IntRange(1), help="That are counted.")
@click.option("--operations", "split", is_flag=True, help="Say what operations take.")
def main(folder: Path, plan: str, threads: tuple[int, ...], rounds: int, split: bool) -> None:
    """Time the parts of a call of the artifact in FOLDER."""
    view = view_of(load_artifact(folder), plan)
    known = view.manifest.pieces
    with view.artifact.reading():
        sessions = [Sessions(count).of(view, blocks=False) for count in threads]
    wanted = (*frame_pieces(known), SCENE, CONDITION, STEP, DENSE_STEP, ADVANCE)
    print(f"| ms | {' | '.join(map(str, threads))} | {threads[-1]} of {threads[0]} |")
    print(f"| --- | {'--- | ' * len(threads)}--- |")
    for piece in (one for one in wanted if one in known and known[one].outputs):
        for name, taken in timed(view, piece, sessions, rounds).items():
            cells = " | ".join(f"{one:.1f}" for one in taken)
            print(f"| {name} | {cells} | {taken[-1] / taken[0]:.2f} |", flush=True)
        if split:
            print("\n".join(operations(view, piece, threads, rounds)), flush=True)


if __name__ == "__main__":
    main()
