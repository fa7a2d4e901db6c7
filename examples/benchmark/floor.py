"""What the arithmetic alone takes: onnxruntime on the same blocks, one after the other, and nothing between them.

    floor of a call = FLOPs of its computed cells / FLOP/s of that

The blocks run in sequence, over and over, as in a dense step, so that the weights come from the same caches as in a
call. Prologue, pruner, tails, additions and the loop are not in it: the quotient of a measured time and its floor is
what all of these cost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import View, view_of
from ttscompile.core.lattice import PlanArray, plan_flops
from ttscompile.ir.pieces import block_name
from ttscompile.report.timing import Contestant, Measurement
from ttscompile.runtimes.instructions import instructions_of
from ttscompile.runtimes.onnxruntime.idle_steps import WORTH
from ttscompile.runtimes.onnxruntime.sessions import Bound, Sessions
from ttscompile.runtimes.onnxruntime.workspace import Workspace
from ttscompile.runtimes.random_calls import random_calls

FLOOR, TAILS = "blocks back to back", "tails back to back"
SEQUENCES = 5
"""How often the blocks are gone through in one timed run: about the cells of a 95 % plan of 100 steps."""


def blocks_contestant(directory: Path, threads: int, plan: str | None = None) -> Contestant:
    """All blocks in order, ``SEQUENCES`` times over; ``flops`` of its measurement are theirs alone.

    Args:
        directory: the artifact.
        threads: of arithmetic.
        plan: in whose precision, and with whose weights; None for the artifact's default.
    """
    view = view_of(load_artifact(directory), plan)
    manifest = view.manifest
    with view.artifact.reading():
        sessions = Sessions(threads).of(view)
    bound = [_bind(view, sessions[block_name(b)], b) for b in range(len(manifest.blocks))] * SEQUENCES

    def call(*_: object) -> None:
        for one in bound:
            one.run()

    total = SEQUENCES * float(sum(manifest.flops.blocks))
    return Contestant(FLOOR, "", call, lambda: None, manifest.spec, total)


def tails_contestant(directory: Path, threads: int, cells: PlanArray, plan: str | None = None) -> Contestant:
    """Tail, sampler and the next step's stem of all K steps of a plan, with no block and no sum between them.

    Args:
        directory: the artifact.
        threads: of arithmetic.
        cells: of the plan, int8 ``[K, blocks]``.
        plan: its name; None for the artifact's default.
    """
    view = view_of(load_artifact(directory), plan)
    manifest = view.manifest
    with view.artifact.reading():
        work = Workspace(view, Sessions(threads).of(view, blocks=False), 1)
    ((obs, noise),) = random_calls(manifest.spec, 1, seed=0)
    for key, spec in manifest.spec.observations.items():
        obs[key] = spec.normalized(obs[key])
    work.start(obs, noise, None)

    lowered = instructions_of(cells, manifest.groups)

    def call(*_: object) -> None:
        k = 0
        while k < manifest.steps:
            if work.idle is None or lowered.idle[k] < WORTH:
                work.advance(k)
                k += 1
                continue
            work.enter_idle(k)
            stop = k + lowered.idle[k]
            while k < stop:
                work.idle.prepare()
                work.run_idle(k, k + lowered.alike[k])
                k += lowered.alike[k]
            work.leave_idle(stop)

    total = float(manifest.steps * (manifest.flops.stem + manifest.flops.tail))
    return Contestant(TAILS, "", call, lambda: None, manifest.spec, total)


def floor_ms(plan: PlanArray, artifact: Artifact, blocks: Measurement) -> float:
    """Milliseconds that the computed cells of a plan take at the speed of ``blocks_contestant``."""
    assert blocks.flops is not None
    rate = blocks.flops / blocks.median_ms
    return plan_flops(plan, artifact.manifest.flops.blocks) / rate


def _bind(view: View, session: object, b: int) -> Bound:
    """A block tied to arrays of random numbers: zeros would have attention and normalisation work on special cases."""
    manifest = view.manifest
    piece, kind = manifest.pieces[block_name(b)], manifest.blocks[b].type
    assert piece.stream is not None
    rng = np.random.default_rng(b)
    types = {piece.stream: kind, **{name: manifest.contexts[name].type for name in piece.contexts}}
    inputs = {name: rng.standard_normal(one.at(1)).astype(one.dtype) for name, one in types.items()}
    return Bound(session, inputs, {piece.outputs[0]: np.zeros(kind.at(1), np.float32)})
