"""Toy policies as compiled programs, written by hand, whose every number can be checked with a pencil or with numpy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ttscompile import Affine, ChunkSpec, Noise, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.write import write_artifact
from ttscompile.ir.graph import Argument, Batch, Graph, Node, Ref, TensorType
from ttscompile.ir.pieces import LoopPiece
from ttscompile.ir.program import Binding, Block, Pieces, Program
from ttscompile.runtimes.reference.model import ReferenceModel

from .literal import Toy

B = Batch()
KINDS = ("self_attention", "feed_forward", "cross_attention")


def f32(*shape: int | Batch) -> TensorType:
    return TensorType(shape, "float32")


def node(name: str, op: str, kind: TensorType, *args: Argument) -> Node:
    return Node(name, f"aten.{op}", args, (), (kind,))


def sampler(steps: int, noise: float = 0.0, **columns: float) -> SamplerTable:
    values = dict.fromkeys(SamplerTable.COLUMNS, 0.0) | columns | {"noise_to_next": noise}
    table = {name: np.full(steps, value, np.float32) for name, value in values.items()}
    return SamplerTable("toy", np.arange(steps)[::-1].copy(), clip=None, **table)


def random_sampler(steps: int, seed: int, memories: int, clip: float | None) -> SamplerTable:
    rng = np.random.default_rng(seed)
    columns = {name: rng.uniform(-0.6, 0.6, steps).astype(np.float32) for name in SamplerTable.COLUMNS}
    return SamplerTable(
        "random",
        np.arange(steps)[::-1].copy(),
        clip=clip,
        **columns,
        memory_to_next=rng.uniform(-0.4, 0.4, (steps, memories)).astype(np.float32),
        to_memory=rng.uniform(-0.4, 0.4, (steps, memories, 3 + memories)).astype(np.float32),
    )


def assemble(
    spec: PolicySpec, pieces: Pieces, kinds: tuple[str, ...], stream: TensorType, weights: Mapping[str, Any]
) -> Program:
    order = list(dict.fromkeys(kinds))
    groups = [order.index(kind) for kind in kinds]
    blocks = tuple(
        Block(i, kind, f"h{i}", f"h{i + 1}", f"r{i}", stream, group)
        for i, (kind, group) in enumerate(zip(kinds, groups, strict=True))
    )
    empty = Graph({}, {}, (), ())
    return Program(
        spec, empty, {k: np.asarray(v, np.float32) for k, v in weights.items()}, blocks, pieces, dense_flops=1000
    )


def pencil_program() -> Program:
    """``f(h) = h - 32`` twice over: K = 2, one block; from x = 35, reuse gives 41 and compute gives 44.

    Step 0: h = 35, f(h) = 3, x = 38. Step 1: reuse 38 + 3 = 41; compute 38 + 6 = 44.
    """
    one = f32(B, 1, 1)
    spec = PolicySpec(
        sample=(1, 1),
        observations={"obs": ObservationSpec((1,))},
        sampler=sampler(2, out_to_next=1.0),
        chunk=ChunkSpec(1, 0, 1),
    )
    pieces = Pieces(
        condition=Graph(
            {"obs": f32(B, 1)}, {}, (node("offset", "unsqueeze.default", one, Ref("obs"), 1),), ("offset",)
        ),
        step=None,
        stem=LoopPiece(
            Graph(
                {"sample": one}, {"unit": f32(1)}, (node("h0", "mul.Tensor", one, Ref("sample"), Ref("unit")),), ("h0",)
            ),
            "sample",
        ),
        blocks=(
            LoopPiece(
                Graph(
                    {"h0": one, "offset": one}, {}, (node("r0", "add.Tensor", one, Ref("h0"), Ref("offset")),), ("r0",)
                ),
                "h0",
            ),
        ),
        tail=LoopPiece(
            Graph({"h1": one}, {"unit": f32(1)}, (node("out", "mul.Tensor", one, Ref("h1"), Ref("unit")),), ("out",)),
            "h1",
        ),
        bindings={"offset": Binding.CONDITION},
    )
    return assemble(spec, pieces, ("feed_forward",), one, {"unit": [1.0]})


def toy_program(
    steps: int = 5,
    blocks: int = 5,
    noise: float = 0.1,
    seed: int = 0,
    pruner: bool = True,
    sequence_first: bool = False,
    normed: bool = False,
    horizon: int = 3,
) -> Program:
    """A policy with contexts of every binding, in which every block matters.

    Block b is ``tanh(h W_b + c_b)`` where c_b is a table row, a condition value or a step value, in turn.
    With ``sequence_first`` the stream is ``[T, B, W]`` rather than ``[B, T, W]``. With ``normed`` the tail begins with
    a LayerNorm; without, it is affine.
    """
    channels, width = 2, 4
    rng = np.random.default_rng(seed)
    stream = f32(horizon, B, width) if sequence_first else f32(B, horizon, width)
    wide = f32(1, B, width) if sequence_first else f32(B, 1, width)
    sample, obs = f32(B, horizon, channels), f32(B, 2)
    axis = 0 if sequence_first else 1
    kinds = tuple(KINDS[b % 2] for b in range(blocks))
    weights = {
        "stem.w": rng.standard_normal((width, channels)),
        "tail.w": rng.standard_normal((channels, width)) / width,
        "cond.w": rng.standard_normal((width, 2)),
        "step.w": rng.standard_normal((width, width)),
        "pruner.w": 0.5 * rng.standard_normal((steps * blocks * 4, width)),
        "pruner.b": 2.0 * rng.standard_normal(steps * blocks * 4),
        "pruner.mask": (np.arange(steps * blocks * 4) < blocks * 4) * np.tile([0, -1e9, -1e9, -1e9], steps * blocks),
        **{f"block.{b}.w": rng.standard_normal((width, width)) / np.sqrt(width) for b in range(blocks)},
    }
    if normed:
        scales = np.random.default_rng((seed, 1))
        weights |= {"norm.w": scales.uniform(0.5, 1.5, width), "norm.b": scales.standard_normal(width)}
    tables = {"row": rng.standard_normal((steps, *wide.at(1))), "time": rng.standard_normal((steps, *wide.at(1)))}
    contexts = ("row", "cond", "stepped")

    def turned(name: str, value: str, kind: TensorType) -> Node:
        return node(name, "transpose.int", kind, Ref(value), 0, 1)

    def block(b: int) -> LoopPiece:
        context = contexts[b % 3]
        nodes = (
            node("y", "linear.default", stream, Ref(f"h{b}"), Ref(f"block.{b}.w")),
            node("z", "add.Tensor", stream, Ref("y"), Ref(context)),
            node(f"r{b}", "tanh.default", stream, Ref("z")),
        )
        graph = Graph({f"h{b}": stream, context: wide}, {f"block.{b}.w": f32(width, width)}, nodes, (f"r{b}",))
        return LoopPiece(graph, f"h{b}")

    in_order = f32(B, horizon, width)
    lift = node("h", "linear.default", in_order, Ref("sample"), Ref("stem.w"))
    stem_nodes = (lift, turned("h0", "h", stream)) if sequence_first else (lift,)
    last = f"h{blocks}"
    arguments = (Ref(last), (width,), Ref("norm.w"), Ref("norm.b"), 1e-5, False)
    norm = (node("n", "layer_norm.default", stream, *arguments),) if normed else ()
    unturned = "n" if normed else last
    back = (*norm, turned("t", unturned, in_order)) if sequence_first else norm
    head = node("out", "linear.default", sample, Ref("t" if sequence_first else unturned), Ref("tail.w"))
    of_norm = {"norm.w": f32(width), "norm.b": f32(width)} if normed else {}
    logits = f32(B, steps, blocks, 4)
    flat = f32(B, steps * blocks * 4)
    squeezed = f32(B, width)
    pieces = Pieces(
        condition=Graph(
            {"obs": obs},
            {"cond.w": f32(width, 2)},
            (
                node("c", "linear.default", squeezed, Ref("obs"), Ref("cond.w")),
                node("cond", "unsqueeze.default", wide, Ref("c"), axis),
            ),
            ("cond",),
        ),
        step=Graph(
            {"cond": wide, "time": wide},
            {"step.w": f32(width, width)},
            (
                node("s", "add.Tensor", wide, Ref("cond"), Ref("time")),
                node("stepped", "linear.default", wide, Ref("s"), Ref("step.w")),
            ),
            ("stepped",),
        )
        if blocks > 2
        else None,
        stem=LoopPiece(
            Graph({"sample": sample}, {"stem.w": f32(width, channels)}, stem_nodes, (stem_nodes[-1].name,)), "sample"
        ),
        blocks=tuple(block(b) for b in range(blocks)),
        tail=LoopPiece(
            Graph({last: stream}, {"tail.w": f32(channels, width), **of_norm}, (*back, head), ("out",)), last
        ),
        pruner=Graph(
            {"cond": wide},
            {n: f32(*np.shape(weights[n])) for n in ("pruner.w", "pruner.b", "pruner.mask")},
            (
                node("feature", "squeeze.dim", squeezed, Ref("cond"), axis),
                node("flat", "linear.default", flat, Ref("feature"), Ref("pruner.w"), Ref("pruner.b")),
                node("masked", "add.Tensor", flat, Ref("flat"), Ref("pruner.mask")),
                node("logits", "reshape.default", logits, Ref("masked"), (B, steps, blocks, 4)),
            ),
            ("logits",),
        )
        if pruner
        else None,
        tables={name: table.astype(np.float32) for name, table in tables.items() if name == "row" or blocks > 2},
        bindings={"row": Binding.TABLE, "time": Binding.TABLE, "cond": Binding.CONDITION, "stepped": Binding.STEP},
        features=("cond",),
    )
    spec = PolicySpec(
        sample=(horizon, channels),
        observations={"obs": ObservationSpec((2,), Affine(np.array([2, 0.5]), np.array([0.1, -0.2])))},
        sampler=sampler(
            steps, noise, sample_to_x0=1.0, out_to_x0=-0.3, x0_to_next=0.4, sample_to_next=0.6, out_to_next=0.2
        ),
        chunk=ChunkSpec(channels, 1, horizon, Affine(np.array([0.5, 4.0]), np.array([1.0, -1.0]))),
    )
    return assemble(spec, pieces, kinds, stream, weights)


def some_noise(streams: int = 2, seed: int = 0) -> Noise:
    """Of a call of ``toy_program()``."""
    rng, shape = np.random.default_rng(seed), (streams, 3, 2)
    return Noise(rng.standard_normal(shape, dtype=np.float32), rng.standard_normal((5, *shape), dtype=np.float32))


def as_functions(program: Program, obs: npt.NDArray[np.float32], noise: npt.NDArray[np.float32] | None) -> Toy:
    """``toy_program`` for one stream in numpy, from its weights alone.

    Args:
        program: made by ``toy_program`` with the batch first.
        obs: normalised, ``[2]``.
        noise: ``[K, T, D]``.
    """
    pieces, weights = program.pieces, {k: np.asarray(v, np.float64) for k, v in program.weights.items()}
    cond = weights["cond.w"] @ obs
    row, time = (np.asarray(pieces.tables[name], np.float64)[:, 0, 0] for name in ("row", "time"))
    table = program.spec.sampler

    def stem(x: npt.NDArray[np.float64], k: int) -> npt.NDArray[np.float64]:
        return x @ weights["stem.w"].T

    def block(h: npt.NDArray[np.float64], k: int, b: int) -> npt.NDArray[np.float64]:
        context = (row[k], cond, weights["step.w"] @ (cond + time[k]))[b % 3]
        return np.tanh(h @ weights[f"block.{b}.w"].T + context)

    memory: list[npt.NDArray[np.float64]] = []

    def advance(h: npt.NDArray[np.float64], x: npt.NDArray[np.float64], k: int) -> npt.NDArray[np.float64]:
        if k == 0:
            memory[:] = [np.zeros_like(x)] * table.memories
        out = h @ weights["tail.w"].T
        clean = table.sample_to_x0[k] * x + table.out_to_x0[k] * out
        if table.clip is not None:
            clean = np.clip(clean, -table.clip, table.clip)
        following = table.x0_to_next[k] * clean + table.sample_to_next[k] * x + table.out_to_next[k] * out
        for s, kept in enumerate(memory):
            following = following + table.memory_to_next[k, s] * kept
        terms = [clean, x, out, *memory]
        memory[:] = [sum((c * term for c, term in zip(row, terms, strict=True)), 0 * x) for row in table.to_memory[k]]
        return following if noise is None else following + table.noise_to_next[k] * noise[k]

    return Toy(tuple(block.group for block in program.blocks), stem, block, advance)


def written_artifact(program: Program, directory: Path) -> Artifact:
    from ttscompile.lower.program import lower_program  # needs torch, which programs written by hand do not

    write_artifact(program, lower_program(program), directory)
    return load_artifact(directory)


def model_of(program: Program) -> ReferenceModel:
    """The reference of a program in memory, after all passes."""
    types, groups = zip(*((block.type, block.group) for block in program.blocks), strict=True)
    return ReferenceModel(program.pieces, program.spec, types, groups, program.weights)


def pruner_weights(program: Program) -> dict[str, torch.Tensor]:
    """The constants of the pruner that may be trained, by name; none without a pruner."""
    pruner = program.pieces.pruner
    own = () if pruner is None else [name for name in pruner.constants if name.startswith("pruner.")]
    return {name: torch.from_numpy(np.array(program.weights[name])) for name in own}


def denoised_by(
    network: torch.nn.Module, table: SamplerTable, spec: PolicySpec, obs: Mapping[str, Any], initial: np.ndarray
) -> np.ndarray:
    """The sample after a loop without noise over an original network, step by step in torch, ``[B, T, D]``."""
    seen, x = torch.from_numpy(spec.observations["obs"].normalized(obs["obs"])), torch.from_numpy(initial)
    with torch.no_grad():
        for k in range(table.steps):
            out = network(x, torch.full((len(x),), int(table.timesteps[k])), seen)
            x0 = float(table.sample_to_x0[k]) * x + float(table.out_to_x0[k]) * out
            moved = float(table.sample_to_next[k]) * x + float(table.out_to_next[k]) * out
            x = float(table.x0_to_next[k]) * x0 + moved
    return x.numpy()
