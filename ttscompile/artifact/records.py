"""From a sound program, its ONNX models and its plans to the records of the manifest; checks that they fit it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.correction import condition_flops, numbers_of
from ..core.lattice import check_schedule, plan_flops, sparsity
from ..core.plan import DENSE, Plan, Variant
from ..core.spec import SamplerTable
from ..core.update import update_flops
from ..errors import ArtifactError
from ..ir import pieces as names
from ..ir.flops import graph_flops, once_flops
from ..ir.layers import layers_graph
from ..ir.pieces import join
from ..ir.program import Program
from .bind import REPORT, interface
from .codec import check_record, plan_fault
from .manifest import PLAN_NAME, BlockRecord, ContextRecord, FlopsRecord, Manifest, PieceRecord, PlanRecord, Requires
from .strict_json import Value, dump_compact, parse
from .towers import TokensRecord
from .typed_json import from_json

if TYPE_CHECKING:
    from onnx import ModelProto

ONNXRUNTIME = "1.23"
MAX_OPSET, MAX_IR = 23, 11
"""What ``ONNXRUNTIME`` reads: 1.22.1 refuses opset 23, 1.23.2 opens and runs it (tried). Also in pyproject.toml."""

PRUNER_PREFIX = "pruner."


def block_records(program: Program) -> tuple[BlockRecord, ...]:
    """The block table; FLOPs are those of the pieces, which is what is left after hoisting."""
    return tuple(
        BlockRecord(kind=b.kind, type=b.type, group=b.group, flops=graph_flops(piece.graph), reason=b.reason)
        for b, piece in zip(program.blocks, program.pieces.blocks, strict=True)
    )


def flops_record(program: Program) -> FlopsRecord:
    """FLOPs of one call's parts for one stream."""
    pieces, types = program.pieces, program.pieces.conditions
    steps, sample = program.spec.sampler.steps, program.spec.sample
    step = 0 if pieces.step is None else graph_flops(pieces.step) * steps
    read = condition_flops(steps, sample, numbers_of(types[name].at(1) for name in pieces.features))
    return FlopsRecord(
        dense=program.dense_flops,
        prologue=once_flops(pieces) + step + read,
        pruner=0 if pieces.pruner is None else graph_flops(pieces.pruner),
        stem=graph_flops(pieces.stem.graph),
        tail=graph_flops(pieces.tail.graph) + update_flops(program.spec.sampler, sample),
        blocks=tuple(graph_flops(piece.graph) for piece in pieces.blocks),
    )


def tokens_records(program: Program) -> dict[str, TokensRecord]:
    """The tokens of each tower, and of the scene, that has a form for some of them, by its piece."""
    from ..ir.tokens import words_of  # it needs torch, which those who only read artifacts may not have

    records = {}
    for piece in program.pieces.once():
        if (graph := program.pieces.tokens.get(names.tokens_name(piece))) is None:
            continue
        kept = names.kept_inputs(graph)
        tokens = next(iter(kept.values())).at(1)[0]
        if piece == names.SCENE:  # a row of the sequence is the patch of its token
            words = words_of(program.pieces.tokens[names.pixels_name(piece)], program.weights)
            records[piece] = TokensRecord(tokens, 0, (1, graph.inputs[names.PIXELS].at(1)[3]), kept, words)
            continue
        patches = next(node for node in graph.nodes if node.op.startswith("aten.conv"))
        _, weight = list(patches.refs())[:2]
        high, wide = graph.constants[weight].at(1)[2:]
        records[piece] = TokensRecord(tokens, tokens - math.prod(patches.type.at(1)[2:]), (high, wide), kept)
    return records


def context_records(program: Program) -> dict[str, ContextRecord]:
    """Binding and type of every context, in order of first use; the pruner reads features, and so may corrections."""
    pieces, readers = program.pieces, [piece.contexts for piece in program.pieces.loop.values()]
    readers[:0] = [] if pieces.step is None else [dict(pieces.step.inputs)]
    readers += [] if pieces.pruner is None else [dict(pieces.pruner.inputs)]
    types = {name: kind for contexts in readers for name, kind in contexts.items()}
    return {name: ContextRecord(binding=pieces.bindings[name], type=kind) for name, kind in types.items()}


def piece_records(
    program: Program, models: Mapping[str, ModelProto], files: Mapping[str, str]
) -> dict[str, PieceRecord]:
    """One record an ONNX model.

    Args:
        models: from ``lower_program``: of the same names, but ``advance`` in place of ``tail``, ``blocks``,
            ``dense_step``, and perhaps ``idle`` and ``layers``.
        files: file name of each model.
    """
    optional = {names.IDLE, *(names.of_loop(names.ADVANCE, loop) for loop in program.spec.loops)}
    expected = {name: one for name, one in _interfaces(program).items() if name not in optional or name in models}
    if set(models) != set(expected):
        raise ArtifactError(f"expected the ONNX models {sorted(expected)}; found {sorted(models)}. {REPORT}")
    records = {}
    for name, wanted in expected.items():
        inputs, results = interface(models[name])
        if (set(inputs), results) != (set(wanted.inputs), wanted.outputs):
            raise ArtifactError(
                f"ONNX model {name!r}: expected inputs {list(wanted.inputs)} and outputs {list(wanted.outputs)}; found"
                f" {list(inputs)} and {list(results)}. {REPORT}"
            )
        records[name] = replace(wanted, file=files[name], inputs=inputs)
    return records


def requirements(models: Mapping[str, ModelProto]) -> Requires:
    """What these models need. Raises ArtifactError: more than the onnxruntime that the package asks for."""
    opset = max(entry.version for model in models.values() for entry in model.opset_import if not entry.domain)
    ir = max(model.ir_version for model in models.values())
    if opset > MAX_OPSET or ir > MAX_IR:
        raise ArtifactError(
            f"the ONNX models need opset {opset} and IR version {ir}; onnxruntime {ONNXRUNTIME} reads opset {MAX_OPSET}"
            f" and IR version {MAX_IR}. {REPORT}"
        )
    return Requires(onnxruntime=ONNXRUNTIME, opset=opset)


def plan_records(manifest: Manifest, plans: Mapping[str, Plan], record: Mapping[str, Any]) -> dict[str, PlanRecord]:
    """Records of plans by name, ``dense`` left out; see ``write.update_plans``.

    Raises:
        IllegalPlanError: cells that do not fit the policy.
    """
    made = dict[str, PlanRecord]()
    for name, plan in sorted(plans.items()):
        if name == DENSE:
            if plan.cells is None or plan.cells.any() or plan.variant != Variant() or plan.correction is not None:
                raise ArtifactError("plan 'dense': expected another name, since that is the original policy.")
            continue
        if not PLAN_NAME.holds(name):
            raise ArtifactError(f"plan {name!r}: expected {PLAN_NAME.expected}.")
        otherwise = next((other for other, one in plans.items() if one is plan.otherwise), None)
        if otherwise is None and plan.otherwise is not None:
            raise ArtifactError(f"plan {name!r}: its plan for calls without a chunk is none of {sorted(plans)}.")
        fields = {
            "loop": plan.loop,
            "weights": plan.weights,
            "precision": dict(sorted(plan.precision.items())),
            "tokens": None if plan.tokens is None else dict(vars(plan.tokens)),
            "otherwise": otherwise,
        }
        if plan.cells is None:
            if manifest.stores.pruner is None:
                raise ArtifactError(
                    f"plan {name!r}: the artifact has no pruner to make it. Convert the checkpoint again."
                )
            score = record.get("plans", {}).get(name, {})
            told = {"kind": names.PRUNER, **{key: score.get(key) for key in ("sparsity", "flops_sparsity")}}
        else:
            cells = np.asarray(plan.cells)
            steps = manifest.steps_of(plan.loop) if plan.loop in manifest.loops else len(cells)
            check_schedule(name, cells, steps, len(manifest.blocks))
            total = steps * sum(manifest.flops.blocks)
            weighed = 1 - plan_flops(cells, manifest.flops.blocks) / total if total else sparsity(cells)
            kind = "schedule" if cells.any() else "all"
            told = {"kind": kind, "sparsity": sparsity(cells), "flops_sparsity": weighed}
        made[name] = from_json(PlanRecord, Value({**told, **fields}, f"plan {name!r}"))
    for name, one in made.items():
        if fault := plan_fault(replace(manifest, plans=made), one):
            raise ArtifactError(f"plan {name!r}: expected {fault}.")
    return made


def calibration_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record as it will be read back."""
    try:
        content = dump_compact(dict(record))
    except (TypeError, ValueError) as error:
        raise ArtifactError(f"calibration record: expected JSON; found {error}. Convert arrays to lists.") from error
    read = parse(content, "calibration record")
    check_record(read)
    return dict(read.data)


def _interfaces(program: Program) -> dict[str, PieceRecord]:
    pieces, sampler = program.pieces, program.spec.sampler

    def record(
        inputs: Iterable[str], outputs: tuple[str, ...], stream: str | None = None, contexts: Iterable[str] = ()
    ) -> PieceRecord:
        return PieceRecord("", tuple(inputs), stream, tuple(dict.fromkeys(contexts)), outputs)

    step, pruner, tail, stem = pieces.step, pieces.pruner, pieces.tail, pieces.stem
    found = {name: record(graph.inputs, graph.outputs) for name, graph in {**pieces.once(), **pieces.tokens}.items()}
    if step is not None:
        found[names.STEP] = record(step.inputs, step.outputs, contexts=step.inputs)
    if pruner is not None:
        found[names.PRUNER] = record(pruner.inputs, pruner.outputs)
    for loop, graph in pieces.loop_pruners.items():
        found[names.of_loop(names.PRUNER, loop)] = record(graph.inputs, graph.outputs)
    for name, piece in pieces.loop.items():
        if piece is not tail:
            found[name] = record(piece.graph.inputs, piece.graph.outputs, piece.stream, piece.contexts)
    own = [
        names.advance_context(name, n)
        for name, piece in ((names.TAIL, tail), (names.STEM, stem))
        for n in piece.contexts
    ]

    def advance(sampler: SamplerTable) -> PieceRecord:
        around = (*names.advance_inputs(sampler), *own)
        return record(around, names.advance_outputs(sampler), names.STREAM, (*tail.contexts, *stem.contexts))

    found[names.ADVANCE] = advance(sampler)
    found |= {names.of_loop(names.ADVANCE, loop): advance(table) for loop, table in program.spec.loops.items()}
    joint = join([tuple(piece.contexts.values()) for piece in pieces.blocks])
    found[names.JOINT] = record(joint.inputs, (names.RESIDUAL,), names.STREAM)
    read = dict.fromkeys(name for piece in pieces.blocks for name in piece.contexts)
    whole = (names.STREAM, *(names.CONTEXT + name for name in read))
    found[names.DENSE_STEP] = record(whole, names.dense_step_outputs(len(pieces.blocks)), names.STREAM, read)
    if (inside := layers_graph(program)) is not None:
        (block,) = pieces.blocks
        found[names.LAYERS] = record(inside.inputs, inside.outputs, block.stream, block.contexts)
    found[names.IDLE] = record((names.TOTAL,), names.IDLE_OUTPUTS)
    return found
