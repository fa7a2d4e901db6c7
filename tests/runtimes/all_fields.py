"""A small policy with everything that a plan can name, and plans that are random in all of their fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

import ttscompile
from tests.families import cameras
from tests.literal_tokens import LiteralChoice, LiteralTokens
from tests.once import Once
from ttscompile import Plan, TokenReuse
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.artifact.stores import BlockWeights
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import update_plans
from ttscompile.core.coercion import Array
from ttscompile.core.lattice import Source
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.ir.pieces import INDEX, PLACES, PRUNER, ROWS, is_block, of_loop
from ttscompile.ir.program import once_values
from ttscompile.lower.precision import quantize_model
from ttscompile.runtimes.frames import FramePieces
from ttscompile.runtimes.tokens import Lane, TokenTower, TokenWork
from ttscompile.samplers.flow import flow_matching_table

from .plans import random_correction, random_plan

BLOCKS, LOOPS = 4, {"original": 5, "euler-4": 4}
STARTS = {"original-last-2": StartRecord("original", 2), "euler-4-last-3": StartRecord("euler-4", 3)}
PARTS = ("blocks", "frame_00", "frame_01", "condition")
"""``frame_01`` is the image encoder, which has tokens; ``frame_00`` reads the instruction."""


def compiled(once: Once, precision: str) -> Path:
    """A folder with ``artifact`` and ``call.onnx``, its single file.

    Two loops with a pruner each, two that begin with the chunk before, two sets of weights, an image encoder with
    tokens, and fp32 and another precision.
    """

    def make(folder: Path) -> None:
        _, spec = cameras.policy("clip", told=True)
        denoiser = cameras.Denoiser(8 * 2 * cameras.TO + 4 * cameras.TO + 8)
        denoiser.blocks = torch.nn.ModuleList(torch.nn.Linear(16, 16) for _ in range(BLOCKS))
        with torch.no_grad():
            denoiser.read.weight *= 8  # actions depend on what is seen
        module, path = EncodedDenoiser(cameras.Encoder("clip", told=True), denoiser).eval(), folder / "artifact"
        tables = {name: flow_matching_table(steps) for name, steps in LOOPS.items()}
        spec = replace(spec, sampler=tables.pop("original"), loops=tables)
        ttscompile.compile_denoiser(module, spec, path, precision=precision, single_file=folder / "call.onnx")
        artifact, rng = load_artifact(path), np.random.default_rng(0)
        weights, dense = {"trained": trained(artifact, rng)}, artifact.plans["dense"]
        plans = {**artifact.plans, "pruner": Plan(), "four": Plan("euler-4")}
        plans["trained"] = replace(dense, weights="trained")
        for name, start in STARTS.items():
            cells = np.zeros((start.steps, BLOCKS), np.int8)
            plans[name] = Plan(name, cells, otherwise=dense if start.loop == "original" else plans["four"])
        more: dict[str, Any] = {"weights": weights, "starts": STARTS}
        for loop in LOOPS:
            head = artifact.graphs[PRUNER if loop == "original" else of_loop(PRUNER, loop)].constants
            pruner = {name: rng.standard_normal(kind.at(1)).astype(np.float32) for name, kind in head.items()}
            pruner["pruner.mask"][:] = 0
            update_plans(path, plans, "dense", pruner_weights=pruner, pruner_loop=loop, **more)

    return once.folder(f"all fields of a plan, {precision}", make)


def trained(artifact: Artifact, rng: np.random.Generator) -> BlockWeights:
    """Other weights for all blocks, in both precisions."""
    record = artifact.manifest.precision
    assert record is not None
    blocks = [piece for piece in artifact.graphs if is_block(piece)]
    names = sorted({name for piece in blocks for name in artifact.graphs[piece].constants})
    own = {name: artifact.weights[name] for name in names if artifact.weights[name].dtype == np.float32}
    moved = {n: a + np.float32(0.1) * rng.standard_normal(a.shape).astype(np.float32) for n, a in own.items()}
    lower = dict[str, Array]()
    for piece in filter(is_block, record.models):
        model = onnx.load(artifact.path / artifact.manifest.pieces[piece].file, load_external_data=False)
        lower |= quantize_model(model, {**artifact.weights, **moved}, precision=record.name)[1]
    return BlockWeights(moved, lower)


@dataclass(frozen=True)
class Drawn:
    """What may be drawn: precisions by name, of any parts."""

    artifact: Artifact
    precisions: Sequence[str]

    def variants(self, rng: np.random.Generator, count: int) -> list[dict[str, Any]]:
        """So many that differ in more than precision and tokens, which the reference has all alike."""
        found = dict[tuple[str, str], dict[str, Any]]()
        while len(found) < count:
            one = self._variant(rng)
            loop = STARTS[one["loop"]].loop if one["loop"] in STARTS else one["loop"]
            found[loop, one["weights"]] = one
        return list(found.values())

    def _variant(self, rng: np.random.Generator) -> dict[str, Any]:
        """Loop, weights, precision and tokens."""
        one, parts = str(rng.choice(self.precisions)), [part for part in PARTS if rng.random() < 0.3]
        reuse = TokenReuse(float(rng.choice([0.0, 0.05, 0.2])), int(rng.integers(1, 6)))
        return {
            "loop": str(rng.choice([*LOOPS, *STARTS])),
            "weights": str(rng.choice(["original", "trained"])),
            "precision": dict.fromkeys(parts, one),
            "tokens": reuse if rng.random() < 0.5 else None,
        }

    def plan(self, rng: np.random.Generator, fields: Mapping[str, Any], streams: int) -> Plan:
        """A plan of this variant, and one for calls without a chunk where its loop needs one."""
        start, groups = STARTS.get(fields["loop"]), self.artifact.manifest.groups
        otherwise = None if start is None else self.plan(rng, {**fields, "loop": start.loop}, streams)
        steps, cells = self.artifact.manifest.steps_of(fields["loop"]), None
        if rng.random() < 0.75:
            nothing = np.zeros((steps, BLOCKS), np.bool_)
            one = [random_plan(rng, steps, groups, nothing, rng.uniform(0.1, 0.5)) for _ in range(streams)]
            cells = np.stack(one) if rng.random() < 0.5 else one[0]
            if rng.random() < 0.7:  # there may be nothing to read
                cells[..., 1:, :][rng.random(cells[..., 1:, :].shape) < 0.1] = Source.ROLLOUT
        plan = Plan(cells=cells, otherwise=otherwise, repair=rng.random() < 0.7, **fields)
        if rng.random() < 0.5:
            own, late = (random_correction(view_of(self.artifact, plan), rng) for _ in range(2))
            plan = replace(plan, correction=replace(own, late=late, prefixes=1) if rng.random() < 0.5 else own)
        return plan


class Scene:
    """Two cameras of each stream, and what may happen to them from frame to frame."""

    def __init__(self, rng: np.random.Generator, streams: int) -> None:
        self.rng, self.number = rng, 0
        self.pairs = [self._new() for _ in range(streams)]
        self.before = self.frame()

    def _new(self) -> tuple[Array, Array]:
        self.number += 2
        return cameras.picture(self.number), cameras.picture(self.number + 1)

    def frame(self) -> dict[str, Array]:
        """What they show now, and an instruction."""
        words = np.tile(np.arange(cameras.WORDS) + self.number % 3, (len(self.pairs), 1))
        told = {"tokens": words.astype(np.int64), "mask": words % 5 > 0}
        return {**cameras.frame(*self.pairs), **told}

    def step(self) -> dict[str, Array]:
        """The window ``[B, To, ...]`` after something has happened to each stream."""
        for stream, pair in enumerate(self.pairs):
            match self.rng.choice(["still", "patch", "patches", "both", "light", "new", "swapped"]):
                case "patch":
                    pair = (cameras.moved(pair[0], int(self.rng.integers(36)), self.rng.uniform(0.01, 0.5)), pair[1])
                case "patches":
                    pair = (pair[0], self._some(pair[1]))
                case "both":
                    pair = (self._some(pair[0]), self._some(pair[1]))
                case "light":
                    pair = (pair[0] + np.float32(0.04), pair[1])
                case "new":
                    pair = self._new()
                case "swapped":
                    pair = (pair[1], pair[0])
            self.pairs[stream] = np.clip(pair[0], 0, 1), np.clip(pair[1], 0, 1)
        before, self.before = self.before, self.frame()
        windows = ("left", "right", "state")
        return {k: np.stack([before[k], v], 1) if k in windows else v for k, v in self.before.items()}

    def _some(self, image: Array) -> Array:
        for patch in self.rng.choice(36, size=int(self.rng.integers(1, 30)), replace=False):
            image = cameras.moved(image, int(patch), self.rng.uniform(0.0, 0.4))
        return image


class Literally:
    """What tokens literally give, for the reference: made beside every tower, of what that one decides to compute.

    What it decides has to be what the definition says.

    Args:
        name: of the tower that has tokens.

    Attributes:
        frames: the frames whose tokens the reference's next call has; None for all computed.
        works: what was done for each new frame.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, artifact: Artifact, name: str = "frame_01") -> None:
        self.frames: FramePieces | None = None
        self.works = list[TokenWork]()
        self._artifact, self._name, self._compute = artifact, name, TokenTower.compute
        self._literal, self._given = dict[Any, LiteralTokens](), dict[Any, list[Array]]()
        self._choice = dict[Any, LiteralChoice]()
        monkeypatch.setattr(TokenTower, "compute", lambda tower, lane, row: self.compute(tower, lane, row))
        monkeypatch.setattr("ttscompile.runtimes.reference.model.once_values", self.values)

    def compute(self, tower: TokenTower, lane: Lane, row: Mapping[str, Array]) -> tuple[tuple[Array, ...], TokenWork]:
        """In place of the tower's, which it asks."""
        fed, renew, known = dict[str, Array](), tower._renew, lane in tower._lanes

        def heard(piece: str, feed: Any, kept: Any) -> Any:
            fed.update(feed)
            return renew(piece, feed, kept)

        tower._renew = heard
        try:
            values, work = self._compute(tower, lane, row)
        finally:
            tower._renew = renew
        (pixels,), similar, index = row.values(), dict[int, int](), list[int]()
        if not known:
            record = tower._record
            self._literal[tower, lane] = LiteralTokens(self._artifact.graph(self._name), self._artifact.weights)
            self._choice[tower, lane] = LiteralChoice(tower._reuse, record.fixed, record.patch)
        if fed:
            index = fed[INDEX].tolist()
            written = zip(fed[PLACES].tolist(), fed[INDEX][fed[ROWS]].tolist(), strict=True)
            similar = {place: source for place, source in written if place not in index}
            self._given[tower, lane, None] = self._literal[tower, lane](pixels, index, similar)
        self._given[tower, lane, pixels.tobytes()] = self._given[tower, lane, None]
        (read,) = tower._run(tower._pixels, row)
        why = self._choice[tower, lane].require(read[0], index, similar)
        told: dict[str, Any] = {**why, "camera": lane.camera, "stream": lane.stream, "forward": len(similar)}
        assert work == TokenWork(tower.tokens, **told)
        self.works.append(work)
        return values, work

    def values(self, pieces: Any, run: Any, obs: Any) -> Any:
        """In place of ``once_values``: the same, but for tokens that are reused."""
        seen, frames = {key: value.numpy() for key, value in obs.items()}, self.frames

        def heard(piece: str, given: Any) -> Any:
            if piece != self._name or frames is None or not frames.reuses_tokens:
                return run(piece, given)
            return list(map(torch.from_numpy, self.given(frames, seen, next(iter(given.values())).numpy())))

        return once_values(pieces, heard, obs)

    def given(self, frames: FramePieces, obs: Mapping[str, Array], rows: Array) -> list[Array]:
        """What the tower gives for rows ``[N, ...]`` that were made of observations, by output."""
        (tower,), lanes = frames._tokens.values(), frames._lanes_of(self._name, obs)
        each = [self._given[tower, lane, row[None].tobytes()] for lane, row in zip(lanes, rows, strict=True)]
        return [np.concatenate(values) for values in zip(*each, strict=True)]
