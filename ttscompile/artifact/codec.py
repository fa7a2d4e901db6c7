"""``manifest.json``: the records of ``manifest`` to bytes, and strictly back.

Nothing but numpy is needed to read one.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from typing import Any

from ..core.spec import INT8
from ..errors import ArtifactError
from ..ir.pieces import ADVANCE, CONDITION, OF_ALL_BLOCKS, PRUNER, STEM, block_name
from ..ir.program import Binding
from .manifest import (
    DENSE,
    FORMAT,
    MANIFEST,
    SCHEMA_VERSION,
    BlockRecord,
    ContextRecord,
    FileRecord,
    FlopsRecord,
    Manifest,
    PieceRecord,
    PlanRecord,
    PrecisionError,
    PrecisionRecord,
    Requires,
    Stores,
)
from .spec_json import spec_from_json, spec_to_json, type_from_json, type_to_json
from .strict_json import Value, dump, dump_compact, parse

MAX_MANIFEST_BYTES = 32 * 2**20

_FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
_HASH = re.compile(r"[0-9a-f]{64}")


def encode(manifest: Manifest) -> bytes:
    """The bytes of ``manifest.json``; the last member is a checksum of all the others."""
    document = to_json(manifest)
    return dump({**document, "checksum": _checksum(document)})


def decode(content: bytes, where: str = MANIFEST) -> Manifest:
    """Read ``manifest.json``.

    Raises:
        ArtifactError: no manifest, another schema version, or one that was changed or damaged.
    """
    root = parse(content, where, MAX_MANIFEST_BYTES)
    members = root.members()
    if "format" not in members or members["format"].data != FORMAT:
        raise ArtifactError(
            f"{where}: expected the manifest of a ttscompile artifact (format {FORMAT!r}); found another document."
            " Give the directory that 'ttscompile convert' wrote."
        )
    _check_schema(members, where)
    checksum = members.pop("checksum", None)
    document = {key: member.data for key, member in members.items()}
    if checksum is None or checksum.data != _checksum(document):
        raise ArtifactError(
            f"{where}: expected the checksum of its content; found"
            f" {'none' if checksum is None else 'another'}. The manifest was changed or damaged since it was written:"
            " copy the artifact again, or convert the checkpoint again."
        )
    return from_json(Value(document, where))


def to_json(manifest: Manifest) -> dict[str, Any]:
    """The manifest as JSON, without the checksum."""
    document = {
        "format": FORMAT,
        "schema_version": manifest.schema_version,
        "ttscompile_version": manifest.ttscompile_version,
        "identity": manifest.identity,
        "model_identity": manifest.model_identity,
        "spec": spec_to_json(manifest.spec),
        "blocks": [
            {"kind": b.kind, "type": type_to_json(b.type), "group": b.group, "flops": b.flops, "reason": b.reason}
            for b in manifest.blocks
        ],
        "pieces": {
            name: {
                "file": p.file,
                "inputs": list(p.inputs),
                "stream": p.stream,
                "contexts": list(p.contexts),
                "outputs": list(p.outputs),
            }
            for name, p in manifest.pieces.items()
        },
        "contexts": {
            name: {"binding": c.binding.value, "type": type_to_json(c.type)} for name, c in manifest.contexts.items()
        },
        "features": list(manifest.features),
        "flops": {**vars(manifest.flops), "blocks": list(manifest.flops.blocks)},
        "plans": {name: dict(vars(plan)) for name, plan in manifest.plans.items()},
        "default_plan": manifest.default_plan,
        "calibration": None if manifest.calibration is None else dict(manifest.calibration),
        "stores": dict(vars(manifest.stores)),
        "requires": dict(vars(manifest.requires)),
        "files": {name: dict(vars(manifest.files[name])) for name in sorted(manifest.files)},
    }
    # Without the member the blocks are in fp32, as in every manifest that was written before there was another.
    return document if manifest.precision is None else {**document, "precision": _precision_to_json(manifest.precision)}


def from_json(root: Value) -> Manifest:
    """Inverse of ``to_json``; checks that the parts fit each other.

    Raises:
        ArtifactError: names the path in the document, expected and found.
    """
    members = root.members()
    precision = members.get("precision")
    fields = Value({key: value.data for key, value in members.items() if key != "precision"}, root.path).keys(
        *("format", "schema_version", "ttscompile_version", "identity", "model_identity", "spec", "blocks"),
        *("pieces", "contexts", "features", "flops", "plans", "default_plan", "calibration", "stores", "requires"),
        "files",
    )
    calibration = fields["calibration"]
    manifest = Manifest(
        schema_version=fields["schema_version"].integer(),
        ttscompile_version=fields["ttscompile_version"].text(),
        identity=_sha256(fields["identity"]),
        model_identity=_sha256(fields["model_identity"]),
        spec=spec_from_json(fields["spec"]),
        blocks=tuple(_block(item) for item in fields["blocks"].items()),
        pieces={name: _piece(item) for name, item in fields["pieces"].members().items()},
        contexts={name: _context(item) for name, item in fields["contexts"].members().items()},
        features=_texts(fields["features"]),
        flops=_flops(fields["flops"]),
        plans={name: _plan(item) for name, item in fields["plans"].members().items()},
        default_plan=fields["default_plan"].text(),
        calibration=None if calibration.absent else {k: v.data for k, v in calibration.members().items()},
        stores=_stores(fields["stores"]),
        requires=_requires(fields["requires"]),
        files={_file_name(name, item): _file(item) for name, item in fields["files"].members().items()},
        precision=None if precision is None else _precision(precision),
    )
    if precision is not None:
        _check_precision(manifest, precision)
    _check_parts(manifest, fields)
    return manifest


def _check_parts(manifest: Manifest, fields: Mapping[str, Value]) -> None:
    blocks = len(manifest.blocks)
    if len(manifest.flops.blocks) != blocks:
        fields["flops"].fail(f"FLOPs of {blocks} blocks")
    missing = {CONDITION, STEM, ADVANCE, *OF_ALL_BLOCKS, *map(block_name, range(blocks))} - set(manifest.pieces)
    if missing:
        fields["pieces"].fail(f"the pieces {sorted(missing)} too")
    for name, piece in manifest.pieces.items():
        if not set(piece.contexts) <= set(manifest.contexts):
            fields["pieces"].fail(f"contexts of {name} that are among {list(manifest.contexts)}")
    has_pruner = PRUNER in manifest.pieces
    if has_pruner != (manifest.stores.pruner is not None):
        fields["stores"].fail("a file of pruner weights exactly when there is a piece called pruner")
    if not has_pruner and any(plan.pruned for plan in manifest.plans.values()):
        fields["plans"].fail("no plan of the kind pruner, because there is no piece called pruner")
    files = {piece.file for piece in manifest.pieces.values()} | {n for n in vars(manifest.stores).values() if n}
    if manifest.precision is not None:
        files |= {manifest.precision.weights, *manifest.precision.models.values()}
    if files != set(manifest.files):
        fields["files"].fail(f"exactly the files {sorted(files)}")
    if DENSE in manifest.plans:
        fields["plans"].fail("no plan called 'dense', which every artifact has")
    if manifest.default_plan not in {DENSE, *manifest.plans}:
        fields["default_plan"].fail(f"one of {[DENSE, *manifest.plans]}")
    scheduled = any(not plan.pruned for plan in manifest.plans.values())
    if scheduled != (manifest.stores.plans is not None):
        fields["stores"].fail("a file of plans exactly when there are schedules")


def _check_precision(manifest: Manifest, value: Value) -> None:
    record = manifest.precision
    assert record is not None
    known = list(map(block_name, range(len(manifest.blocks))))
    single = set(record.models) - set(OF_ALL_BLOCKS)
    if not single or not single <= set(known):
        value.fail(f"models of some of the blocks {', '.join(known)} and of nothing else")
    if not set(OF_ALL_BLOCKS) <= set(record.models):
        value.fail(f"models called {' and '.join(OF_ALL_BLOCKS)} too")
    own = {record.weights, *record.models.values()}
    others = {piece.file for piece in manifest.pieces.values()} | set(vars(manifest.stores).values())
    if len(own) <= len(record.models) or own & others:
        value.fail("a file for each model and one for the weights, which nothing else uses")


def _check_schema(members: Mapping[str, Value], where: str) -> None:
    found = members["schema_version"].data if "schema_version" in members else None
    if found == SCHEMA_VERSION and type(found) is int:
        return
    writer = members["ttscompile_version"].data if "ttscompile_version" in members else None
    install = f"ttscompile=={writer}, which wrote it" if isinstance(writer, str) else "the ttscompile that wrote it"
    raise ArtifactError(
        f"{where}: schema_version: expected {SCHEMA_VERSION}, the only one that this ttscompile reads; found {found!r}."
        f" Convert the checkpoint again with this version, or install {install}."
    )


def _checksum(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(dump_compact(document)).hexdigest()


def _sha256(value: Value) -> str:
    if _HASH.fullmatch(value.text()) is None:
        value.fail("64 hexadecimal digits")
    return value.text()


def _texts(value: Value) -> tuple[str, ...]:
    return tuple(item.text() for item in value.items())


def _file_name(name: str, value: Value) -> str:
    if _FILE_NAME.fullmatch(name) is None or name == MANIFEST:
        Value(name, value.path).fail("a plain file name: no folder, no leading dot, not manifest.json")
    return name


def _block(value: Value) -> BlockRecord:
    fields = value.keys("kind", "type", "group", "flops", "reason")
    return BlockRecord(
        kind=fields["kind"].text(),
        type=type_from_json(fields["type"]),
        group=fields["group"].integer(),
        flops=fields["flops"].integer(),
        reason=fields["reason"].text(),
    )


def _piece(value: Value) -> PieceRecord:
    fields = value.keys("file", "inputs", "stream", "contexts", "outputs")
    inputs = _texts(fields["inputs"])
    stream = None if fields["stream"].absent else fields["stream"].text(*inputs)
    return PieceRecord(
        file=_file_name(fields["file"].text(), fields["file"]),
        inputs=inputs,
        stream=stream,
        contexts=_texts(fields["contexts"]),
        outputs=_texts(fields["outputs"]),
    )


def _context(value: Value) -> ContextRecord:
    fields = value.keys("binding", "type")
    allowed = (Binding.TABLE, Binding.CONDITION, Binding.STEP)
    binding = Binding(fields["binding"].text(*(b.value for b in allowed)))
    return ContextRecord(binding=binding, type=type_from_json(fields["type"]))


def _flops(value: Value) -> FlopsRecord:
    fields = value.keys("dense", "prologue", "pruner", "stem", "tail", "blocks")
    blocks = tuple(item.integer() for item in fields.pop("blocks").items())
    return FlopsRecord(**{name: item.integer() for name, item in fields.items()}, blocks=blocks)


def _plan(value: Value) -> PlanRecord:
    fields = value.keys("kind", "sparsity", "flops_sparsity")
    sparsity, weighed = (None if fields[n].absent else fields[n].share() for n in ("sparsity", "flops_sparsity"))
    return PlanRecord(kind=fields["kind"].text("schedule", "pruner"), sparsity=sparsity, flops_sparsity=weighed)


def _stores(value: Value) -> Stores:
    optional = ("pruner", "plans", "golden", "golden_plans")
    fields = value.keys("program", "weights", *optional)
    names = {name: None if fields[name].absent else fields[name].text() for name in optional}
    return Stores(program=fields["program"].text(), weights=fields["weights"].text(), **names)


def _requires(value: Value) -> Requires:
    fields = value.keys("onnxruntime", "opset")
    if re.fullmatch(r"[0-9]+(\.[0-9]+)*", fields["onnxruntime"].text()) is None:
        fields["onnxruntime"].fail("a version like 1.23")
    return Requires(onnxruntime=fields["onnxruntime"].text(), opset=fields["opset"].integer(1))


def _precision_to_json(record: PrecisionRecord) -> dict[str, Any]:
    error = None if record.error is None else dict(vars(record.error))
    return {"name": record.name, "weights": record.weights, "models": dict(record.models), "error": error}


def _precision(value: Value) -> PrecisionRecord:
    fields = value.keys("name", "weights", "models", "error")
    models = {name: _file_name(item.text(), item) for name, item in fields["models"].members().items()}
    return PrecisionRecord(
        name=fields["name"].text(INT8),
        weights=_file_name(fields["weights"].text(), fields["weights"]),
        models=models,
        error=None if fields["error"].absent else _precision_error(fields["error"]),
    )


def _precision_error(value: Value) -> PrecisionError:
    fields = value.keys("calls", "mean", "p90", "largest", "tolerance")
    for name in ("mean", "p90", "largest", "tolerance"):
        if fields[name].number() < 0:
            fields[name].fail("a number that is not negative")
    numbers = {name: fields[name].number() for name in ("mean", "p90", "largest", "tolerance")}
    return PrecisionError(calls=fields["calls"].integer(1), **numbers)


def _file(value: Value) -> FileRecord:
    fields = value.keys("sha256", "bytes")
    return FileRecord(sha256=_sha256(fields["sha256"]), bytes=fields["bytes"].integer())
