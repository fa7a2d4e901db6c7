"""From a compiled program and its ONNX models to the records of the manifest; checks that they fit each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from ..core.spec import SamplerTable
from ..core.update import update_flops
from ..errors import ArtifactError
from ..ir.flops import graph_flops
from ..ir.graph import Graph, TensorType
from ..ir.joint import join
from ..ir.pieces import (
    CONTEXT,
    DENSE_STEP,
    IDLE,
    IDLE_OUTPUTS,
    JOINT,
    OF_ALL_BLOCKS,
    RESIDUAL,
    STREAM,
    TOTAL,
    advance_inputs,
    advance_outputs,
    block_name,
    dense_step_outputs,
)
from ..ir.program import Binding, Pieces, Program
from .manifest import BlockRecord, ContextRecord, FlopsRecord, PieceRecord, Requires

if TYPE_CHECKING:
    from onnx import ModelProto

ONNXRUNTIME = "1.23"
MAX_OPSET, MAX_IR = 23, 11
"""What ``ONNXRUNTIME`` reads: 1.22.1 refuses opset 23, 1.23.2 opens and runs it (tried). Also in pyproject.toml."""

PRUNER_PREFIX = "pruner."
_REPORT = "This is an error in ttscompile; please report it."


def piece_graphs(program: Program) -> dict[str, Graph]:
    """Graphs of all pieces by name: ``condition``, ``step``, ``pruner``, ``stem``, ``block_00``..., ``tail``.

    Raises:
        ArtifactError: the passes have not run.
    """
    pieces = _pieces(program)
    graphs = {"condition": pieces.condition, "step": pieces.step, "pruner": pieces.pruner, "stem": pieces.stem}
    graphs.update({block_name(i): graph for i, graph in enumerate(pieces.blocks)})
    graphs["tail"] = pieces.tail
    return {name: graph for name, graph in graphs.items() if graph is not None}


def constants(program: Program, graphs: Mapping[str, Graph]) -> dict[str, npt.NDArray[Any]]:
    """Values of the constants of these graphs, by name.

    Raises:
        ArtifactError: a constant without a value, or with a value of another type.
    """
    found: dict[str, npt.NDArray[Any]] = {}
    for piece, graph in graphs.items():
        for name, kind in graph.constants.items():
            value = program.weights.get(name)
            if value is None or value.shape != kind.at(1) or str(value.dtype) != kind.dtype:
                shown = "none" if value is None else f"{value.dtype}{list(value.shape)}"
                raise ArtifactError(f"{piece}: constant {name!r} is {kind}; its value is {shown}. {_REPORT}")
            found[name] = value
    return dict(sorted(found.items()))


def block_records(program: Program) -> tuple[BlockRecord, ...]:
    """The block table; FLOPs are those of the pieces, which is what is left after hoisting.

    Raises:
        ArtifactError: table and pieces differ in number.
    """
    graphs = _pieces(program).blocks
    if len(graphs) != len(program.blocks):
        raise ArtifactError(f"the program has {len(program.blocks)} blocks and {len(graphs)} block graphs. {_REPORT}")
    return tuple(
        BlockRecord(kind=b.kind, type=b.type, group=b.group, flops=graph_flops(graph), reason=b.reason)
        for b, graph in zip(program.blocks, graphs, strict=True)
    )


def flops_record(program: Program) -> FlopsRecord:
    """FLOPs of one call's parts for one stream."""
    pieces = _pieces(program)
    step = 0 if pieces.step is None else graph_flops(pieces.step) * program.spec.sampler.steps
    return FlopsRecord(
        dense=program.dense_flops,
        prologue=graph_flops(pieces.condition) + step,
        pruner=0 if pieces.pruner is None else graph_flops(pieces.pruner),
        stem=graph_flops(pieces.stem),
        tail=graph_flops(pieces.tail) + update_flops(program.spec.sampler, program.spec.sample),
        blocks=tuple(map(graph_flops, pieces.blocks)),
    )


def context_records(program: Program, graphs: Mapping[str, Graph]) -> dict[str, ContextRecord]:
    """Binding and type of every context, in order of first use.

    Raises:
        ArtifactError: a context without binding, value or table, or of two types.
    """
    pieces = _pieces(program)
    records: dict[str, ContextRecord] = {}
    for piece, graph in graphs.items():
        for name in _contexts(piece, graph):
            kind, binding = graph.inputs[name], pieces.bindings.get(name)
            known = records.get(name)
            if known is not None and known.type != kind:
                raise ArtifactError(f"{piece}: context {name!r} is {kind} here and {known.type} elsewhere. {_REPORT}")
            if binding is None or not _available(name, binding, kind, pieces, program.spec.sampler.steps):
                shown = "no binding" if binding is None else f"the binding {binding.value}"
                raise ArtifactError(
                    f"{piece}: context {name!r} : {kind} has {shown}, and nothing computes it. {_REPORT}"
                )
            records[name] = ContextRecord(binding=binding, type=kind)
    return records


def piece_records(
    graphs: Mapping[str, Graph], models: Mapping[str, ModelProto], files: Mapping[str, str], sampler: SamplerTable
) -> dict[str, PieceRecord]:
    """One record an ONNX model.

    Args:
        graphs: see ``piece_graphs``.
        models: from ``lower_program``: the same names, but ``advance`` in place of ``tail``, ``blocks``,
            ``dense_step``, and perhaps ``idle``.
        files: file name of each model.
        sampler: of the policy.

    Raises:
        ArtifactError: models and graphs do not have the same names, inputs or outputs.
    """
    expected = [*(name for name in graphs if name != "tail"), "advance", *OF_ALL_BLOCKS, *[IDLE] * (IDLE in models)]
    if set(models) != set(expected):
        raise ArtifactError(f"expected the ONNX models {sorted(expected)}; found {sorted(models)}. {_REPORT}")
    records = {}
    for name in expected:
        model = models[name].graph
        initialized = {tensor.name for tensor in model.initializer}
        inputs = tuple(value.name for value in model.input if value.name not in initialized)
        results = tuple(value.name for value in model.output)
        wanted = _interface(name, graphs, sampler)
        if (set(inputs), results) != (set(wanted[0]), wanted[1]):
            raise ArtifactError(
                f"ONNX model {name!r}: expected inputs {list(wanted[0])} and outputs {list(wanted[1])}; found"
                f" {list(inputs)} and {list(results)}. {_REPORT}"
            )
        records[name] = PieceRecord(
            file=files[name],
            inputs=inputs,
            stream=_stream(name, graphs),
            contexts=_all_contexts(name, graphs),
            outputs=results,
        )
    return records


def requirements(models: Mapping[str, ModelProto]) -> Requires:
    """What these models need.

    Raises:
        ArtifactError: more than the onnxruntime that the package asks for.
    """
    opset = max(entry.version for model in models.values() for entry in model.opset_import if not entry.domain)
    ir = max(model.ir_version for model in models.values())
    if opset > MAX_OPSET or ir > MAX_IR:
        raise ArtifactError(
            f"the ONNX models need opset {opset} and IR version {ir}; onnxruntime {ONNXRUNTIME} reads opset {MAX_OPSET}"
            f" and IR version {MAX_IR}. {_REPORT}"
        )
    return Requires(onnxruntime=ONNXRUNTIME, opset=opset)


def _pieces(program: Program) -> Pieces:
    if program.pieces is None:
        raise ArtifactError(
            "the program has no pieces. Run the passes on it before writing (ttscompile.compile_denoiser)."
        )
    return program.pieces


def _contexts(piece: str, graph: Graph) -> tuple[str, ...]:
    """Inputs that are contexts: all of ``step``, all but the first of a loop piece, none of what runs before."""
    if piece in ("condition", "pruner"):
        return ()
    return tuple(graph.inputs) if piece == "step" else tuple(graph.inputs)[1:]


def _all_contexts(name: str, graphs: Mapping[str, Graph]) -> tuple[str, ...]:
    parts: Iterable[str] = (name,)
    if name in ("advance", JOINT, IDLE, DENSE_STEP):
        parts = {"advance": ("tail", "stem"), DENSE_STEP: filter(_is_block, graphs)}.get(name, ())
    return tuple(dict.fromkeys(context for part in parts for context in _contexts(part, graphs[part])))


def _stream(name: str, graphs: Mapping[str, Graph]) -> str | None:
    if name in ("advance", *OF_ALL_BLOCKS):
        return STREAM
    return None if name in ("condition", "step", "pruner", IDLE) else next(iter(graphs[name].inputs))


def _interface(
    name: str, graphs: Mapping[str, Graph], sampler: SamplerTable
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if name == JOINT:
        return join([tuple(graphs[block].inputs.values())[1:] for block in filter(_is_block, graphs)]).inputs, (
            RESIDUAL,
        )
    if name == DENSE_STEP:
        contexts = [CONTEXT + context for context in _all_contexts(name, graphs)]
        return (STREAM, *contexts), dense_step_outputs(sum(map(_is_block, graphs)))
    if name == IDLE:
        return (TOTAL,), IDLE_OUTPUTS
    if name != "advance":
        return tuple(graphs[name].inputs), graphs[name].outputs
    contexts = [f"{part}.{context}" for part in ("tail", "stem") for context in _contexts(part, graphs[part])]
    return (*advance_inputs(sampler), *contexts), advance_outputs(sampler)


def _is_block(piece: str) -> bool:
    return piece.startswith("block_")


def _available(name: str, binding: Binding, kind: TensorType, pieces: Pieces, steps: int) -> bool:
    if binding is Binding.TABLE:
        table = pieces.tables.get(name)
        return table is not None and table.shape == (steps, *kind.at(1)) and str(table.dtype) == kind.dtype
    if binding is Binding.CONDITION:
        return name in pieces.condition.outputs
    return binding is Binding.STEP and pieces.step is not None and name in pieces.step.outputs
