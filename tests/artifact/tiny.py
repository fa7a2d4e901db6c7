"""A policy of two blocks, built by hand: graphs, weights, and ONNX models written with ``onnx.helper``."""

from pathlib import Path

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto
from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info

from ttscompile.artifact.manifest import Manifest
from ttscompile.artifact.write import write_artifact
from ttscompile.core.spec import Affine, ChunkSpec, ObservationSpec, PolicySpec, SamplerTable
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType
from ttscompile.ir.pieces import LoopPiece, block_name
from ttscompile.ir.program import Binding, Block, Pieces, Program
from ttscompile.lower.joint import lower_all_blocks

STEPS, HORIZON, CHANNELS, WIDTH, MEMORY = 3, 4, 2, 16, 8


def f32(*shape: int | Batch) -> TensorType:
    return TensorType(shape, "float32")


B = Batch()
SAMPLE, STREAM, CONTEXT = f32(B, HORIZON, CHANNELS), f32(B, HORIZON, WIDTH), f32(B, 1, WIDTH)
TURNED = f32(CHANNELS, B, HORIZON)
LOGITS = f32(B, STEPS, 2, 4)


def tiny_spec(seed: int = 0) -> PolicySpec:
    rng = np.random.default_rng(seed)
    columns = {name: rng.standard_normal(STEPS).astype(np.float32) for name in SamplerTable.COLUMNS}
    normalizer = Affine(np.array([0.1, 1 / 3], np.float32), np.array([-0.7, 1e-30], np.float32))
    return PolicySpec(
        sample=(HORIZON, CHANNELS),
        observations={"obs": ObservationSpec((1, 2), normalizer), "goal": ObservationSpec((MEMORY,), None)},
        sampler=SamplerTable(name="ddpm", timesteps=np.array([90, 50, 0]), clip=1.0, **columns),
        chunk=ChunkSpec(action_dim=2, start=0, stop=3, normalizer=normalizer),
        source={"format": "by hand", "architecture": "tiny"},
    )


def linear(name: str, x: str, weight: str, kind: TensorType) -> Node:
    return Node(name, "aten.linear.default", (Ref(x), Ref(weight)), (), (kind,), source="/home/someone/policy.py:7")


def add(name: str, x: str, y: str, kind: TensorType) -> Node:
    return Node(name, "aten.add.Tensor", (Ref(x), Ref(y)), (), (kind,))


def tiny_program(seed: int = 0) -> Program:
    """Weights depend on the seed; everything else is the same."""
    rng = np.random.default_rng(seed)
    shapes = {
        "cond.weight": (WIDTH, 2),
        "step.weight": (WIDTH, WIDTH),
        "stem.weight": (WIDTH, CHANNELS),
        "block.0.weight": (WIDTH, WIDTH),
        "block.1.weight": (WIDTH, WIDTH),
        "tail.weight": (CHANNELS, WIDTH),
        "pruner.weight": (STEPS * 2 * 4, WIDTH),
        "pruner.bias": (STEPS * 2 * 4,),
        "dead.weight": (3,),
    }
    weights: dict[str, np.ndarray] = {n: rng.standard_normal(s).astype(np.float32) for n, s in shapes.items()}
    weights["pruner.shape"] = np.array([-1, STEPS, 2, 4])
    constant = {name: f32(*shape) for name, shape in shapes.items()}
    time = f32(B, 1, WIDTH)
    pieces = Pieces(
        condition=Graph(
            {"obs": f32(B, 1, 2), "goal": f32(B, MEMORY)},
            {"cond.weight": constant["cond.weight"]},
            (linear("memory", "obs", "cond.weight", CONTEXT),),
            ("memory",),
        ),
        step=Graph(
            {"memory": CONTEXT, "time": time},
            {"step.weight": constant["step.weight"]},
            (linear("mixed", "memory", "step.weight", CONTEXT), add("modulation", "mixed", "time", CONTEXT)),
            ("modulation",),
        ),
        stem=LoopPiece(
            Graph(
                {"sample": SAMPLE, "position": f32(1, HORIZON, WIDTH)},
                {"stem.weight": constant["stem.weight"]},
                (linear("embedded", "sample", "stem.weight", STREAM), add("stream_0", "embedded", "position", STREAM)),
                ("stream_0",),
            ),
            "sample",
        ),
        blocks=tuple(
            LoopPiece(
                Graph(
                    {f"stream_{i}": STREAM, context: CONTEXT},
                    {f"block.{i}.weight": constant[f"block.{i}.weight"]},
                    (
                        add(f"in_{i}", f"stream_{i}", context, STREAM),
                        linear(f"r_{i}", f"in_{i}", f"block.{i}.weight", STREAM),
                    ),
                    (f"r_{i}",),
                ),
                f"stream_{i}",
            )
            for i, context in enumerate(("modulation", "memory"))
        ),
        tail=LoopPiece(
            Graph(
                {"stream_2": STREAM},
                {"tail.weight": constant["tail.weight"]},
                (linear("prediction", "stream_2", "tail.weight", SAMPLE),),
                ("prediction",),
            ),
            "stream_2",
        ),
        pruner=Graph(
            {"memory": CONTEXT},
            {
                "pruner.weight": constant["pruner.weight"],
                "pruner.bias": constant["pruner.bias"],
                "pruner.shape": TensorType((4,), "int64"),
            },
            (
                linear("flat", "memory", "pruner.weight", f32(B, 1, STEPS * 8)),
                add("biased", "flat", "pruner.bias", f32(B, 1, STEPS * 8)),
                Node("logits", "aten.reshape.default", (Ref("biased"), (B, STEPS, 2, 4)), (), (LOGITS,)),
            ),
            ("logits",),
        ),
        tables={
            "time": rng.standard_normal((STEPS, 1, 1, WIDTH)).astype(np.float32),
            "position": rng.standard_normal((STEPS, 1, HORIZON, WIDTH)).astype(np.float32),
        },
        bindings={
            "memory": Binding.CONDITION,
            "time": Binding.TABLE,
            "position": Binding.TABLE,
            "modulation": Binding.STEP,
        },
        features=("memory",),
    )
    blocks = tuple(
        Block(i, "feed_forward", f"stream_{i}", f"stream_{i + 1}", f"r_{i}", STREAM, group=0, reason="")
        for i in range(2)
    )
    return Program(
        spec=tiny_spec(seed),
        denoiser=Graph({}, {}, (), ()),
        weights=weights,
        blocks=blocks,
        pieces=pieces,
        dense_flops=123_456,
    )


def tiny_models(program: Program) -> dict[str, ModelProto]:
    """What ``lower_program`` gives: initializers named like constants, without data."""
    pieces = program.pieces
    assert pieces.step is not None
    assert pieces.pruner is not None
    models = {
        "condition": model(pieces.condition, [*project("memory", "obs", "cond.weight")]),
        "step": model(
            pieces.step,
            [*project("mixed", "memory", "step.weight"), make_node("Add", ["mixed", "time"], ["modulation"])],
        ),
        "pruner": model(
            pieces.pruner,
            [
                *project("flat", "memory", "pruner.weight"),
                make_node("Add", ["flat", "pruner.bias"], ["biased"]),
                make_node("Reshape", ["biased", "pruner.shape"], ["logits"]),
            ],
        ),
        "stem": model(
            pieces.stem.graph,
            [*project("embedded", "sample", "stem.weight"), make_node("Add", ["embedded", "position"], ["stream_0"])],
        ),
        "advance": advance(),
    }
    for i, (piece, context) in enumerate(zip(pieces.blocks, ("modulation", "memory"), strict=True)):
        nodes = [
            make_node("Add", [f"stream_{i}", context], [f"in_{i}"]),
            *project(f"r_{i}", f"in_{i}", f"block.{i}.weight"),
        ]
        models[block_name(i)] = model(piece.graph, nodes)
    return {**models, **lower_all_blocks(pieces.blocks, models)}


def write_tiny(target: Path, program: Program | None = None) -> Manifest:
    """Write a program with these models; ``tiny_program`` if none is given."""
    program = program or tiny_program()
    return write_artifact(program, tiny_models(program), target)


def project(result: str, x: str, weight: str) -> list[NodeProto]:
    """``result = x @ weight.T``."""
    return [
        make_node("Transpose", [weight], [f"{result}_t"], perm=[1, 0]),
        make_node("MatMul", [x, f"{result}_t"], [result]),
    ]


def model(graph: Graph, nodes: list[NodeProto]) -> ModelProto:
    types = graph.types()
    return make(nodes, graph.inputs, {name: types[name] for name in graph.outputs}, graph.constants, list(graph.inputs))


def advance() -> ModelProto:
    """Tail, sampler update and stem as one graph."""
    nodes = [
        *project("out", "stream", "tail.weight"),
        make_node("Transpose", ["out"], ["prediction"], perm=[2, 0, 1]),
        make_node("Mul", ["sample", "sample_to_x0"], ["from_sample"]),
        make_node("Mul", ["prediction", "out_to_x0"], ["from_out"]),
        make_node("Sum", ["from_sample", "from_out"], ["x0"]),
        make_node("Clip", ["x0", "low", "high"], ["denoised"]),
        make_node("Concat", ["sample", "prediction", "history", "denoised"], ["features"], axis=2),
        make_node("MatMul", ["features", "update"], ["product"]),
        make_node("Add", ["product", "offset"], ["sample_next"]),
        make_node("Transpose", ["sample_next"], ["following"], perm=[1, 2, 0]),
        *project("embedded", "following", "stem.weight"),
        make_node("Add", ["embedded", "stem.position"], ["stream_next"]),
    ]
    inputs = {
        "stream": STREAM,
        "sample": TURNED,
        "offset": TURNED,
        "history": TensorType((CHANNELS, Batch(), 4 * HORIZON), "float32"),
        "update": f32(CHANNELS, 7 * HORIZON, HORIZON),
        "sample_to_x0": f32(1),
        "out_to_x0": f32(1),
        "stem.position": f32(1, HORIZON, WIDTH),
    }
    constants = {"tail.weight": f32(CHANNELS, WIDTH), "stem.weight": f32(WIDTH, CHANNELS)}
    proto = make(
        nodes, inputs, {"sample_next": TURNED, "stream_next": STREAM, "prediction": TURNED}, constants, list(inputs)
    )
    proto.graph.initializer.extend(
        [
            onnx.numpy_helper.from_array(np.array(-1, np.float32), "low"),
            onnx.numpy_helper.from_array(np.array(1, np.float32), "high"),
        ]
    )
    return proto


def make(nodes, inputs, outputs, constants, order) -> ModelProto:  # type: ignore[no-untyped-def]
    graph = make_graph(
        nodes,
        "tiny",
        [value_info(name, inputs[name]) for name in order],
        [value_info(name, kind) for name, kind in outputs.items()],
        [empty_initializer(name, kind) for name, kind in constants.items()],
    )
    return make_model(graph, opset_imports=[make_opsetid("", 18)], ir_version=10)


def empty_initializer(name: str, kind: TensorType) -> TensorProto:
    tensor = TensorProto(name=name, data_type=onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind.dtype)))
    tensor.dims.extend(kind.at(1))
    return tensor


def value_info(name: str, kind: TensorType):  # type: ignore[no-untyped-def]
    dtype = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind.dtype))
    return make_tensor_value_info(name, dtype, [str(n) if isinstance(n, Batch) else n for n in kind.shape])
