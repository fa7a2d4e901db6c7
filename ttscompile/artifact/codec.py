"""``manifest.json``: the records of ``manifest`` to bytes, and strictly back; and what they describe, as a hash.

Nothing but numpy is needed to read one.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any

from ..core.plan import DENSE, ORIGINAL
from ..core.rules import Hertz
from ..errors import ArtifactError
from ..ir import pieces as names
from . import typed_json
from .manifest import FORMAT, MANIFEST, SCHEMA_VERSION, Manifest, PlanRecord, PrecisionRecord, WeightsRecord
from .strict_json import REMEDY, Value, dump, dump_compact, parse

MAX_MANIFEST_BYTES, MAX_MANIFEST_VALUES = 32 * 2**20, 100_000
"""Of Push-T it has 41 KB and 2,000 values."""


def encode(manifest: Manifest) -> bytes:
    """The bytes of ``manifest.json``; the last member is a checksum of all the others."""
    document = to_json(manifest)
    return dump({**document, "checksum": _checksum(document)})


def decode(content: bytes, where: str = MANIFEST) -> Manifest:
    """Read a ``manifest.json`` of this schema, or of the one before."""
    document = _document(content, where)
    if document.get("format") != FORMAT:
        raise ArtifactError(
            f"{where}: expected the manifest of a ttscompile artifact (format {FORMAT!r}); found another document."
            " Give the directory that 'ttscompile build' wrote."
        )
    found, writer = document.get("schema_version"), document.get("ttscompile_version")
    if found not in (SCHEMA_VERSION, SCHEMA_VERSION - 1) or type(found) is not int:
        install = f"ttscompile=={writer:.40}, which" if isinstance(writer, str) else "the ttscompile that"
        raise ArtifactError(
            f"{where}: schema_version: expected {SCHEMA_VERSION} or the one before, which this ttscompile reads; found"
            f" {found!r:.40}. Convert the checkpoint again with this version, or install {install} wrote it."
        )
    checksum = document.pop("checksum", None)
    if checksum != _checksum(document):
        raise ArtifactError(
            f"{where}: expected the checksum of its content; found {'none' if checksum is None else 'another'}."
            f" {REMEDY}"
        )
    # The schema before says the same: no weight of its files is in 16 bits.
    return from_json(Value({**document, "schema_version": SCHEMA_VERSION}, where))


def _document(content: bytes, where: str) -> dict[str, Any]:
    parsed = parse(content, where, MAX_MANIFEST_BYTES, MAX_MANIFEST_VALUES)
    return {key: member.data for key, member in parsed.members().items()}


def is_as_written(manifest: Manifest, content: bytes) -> bool:
    """Whether these bytes are exactly what ttscompile writes for a manifest, or wrote in the schema before."""
    document = _document(content, MANIFEST)
    return content == (encode(manifest) if document["schema_version"] == SCHEMA_VERSION else dump(document))


def to_json(manifest: Manifest) -> dict[str, Any]:
    """The manifest as JSON, without the checksum."""
    document = typed_json.to_json(manifest)
    return {"format": FORMAT, **document, "files": dict(sorted(document["files"].items()))}


def from_json(root: Value) -> Manifest:
    """Inverse of ``to_json``; checks that the parts fit each other. Errors name the path in the document."""
    members = root.members()
    document = {key: member.data for key, member in members.items() if key != "format"}
    manifest = typed_json.from_json(Manifest, Value(document, root.path))
    if manifest.calibration is not None:
        check_record(members["calibration"])
    uses = _uses(manifest)
    if manifest.precision is not None:
        _check_precision(manifest, manifest.precision, members["precision"], uses)
    for weights, value in zip(manifest.weights.values(), members["weights"].members().values(), strict=True):
        _check_weights(manifest, weights, value, uses)
    _check_plans(manifest, members)
    _check_parts(manifest, members)
    if uses.keys() != manifest.files.keys():
        members["files"].fail(f"exactly the files {sorted(uses)}")
    return manifest


def identities(manifest: Manifest) -> tuple[str, str]:
    """Identity and model identity of what a manifest describes, two sha256; its own two fields are not read.

    The model identity covers graphs, weights, tables, loops, normalisers, observations, chunk and block table. The
    identity covers that, pruners, all fields of all plans by name, which of them is the default, and by name the
    weights and models that plans may take: a calibration belongs to the model with or without them, unless a precision
    has a file of its own for what fp32 alone reads. Every file stands in them with its name, by which others name it,
    and its hash. Neither covers what no action depends on: source, FLOPs, reasons, sparsities, calibration record,
    versions, what is required, and the golden record.
    """
    document, own = to_json(manifest), (names.PRUNER, names.of_loop(names.PRUNER, ""))
    pieces, stores = document["pieces"], {k: v for k, v in document["stores"].items() if k not in _GOLDEN}
    of_model = {name: piece for name, piece in pieces.items() if name != own[0] and not name.startswith(own[1])}
    read = {stores["program"], stores["weights"], manifest.apart, *(piece["file"] for piece in of_model.values())}
    hashes = {name: record.sha256 for name, record in sorted(manifest.acting.items())}
    model_identity = _checksum(
        {
            "spec": {key: value for key, value in document["spec"].items() if key != "source"},
            "blocks": [{key: block[key] for key in ("kind", "type", "group")} for block in document["blocks"]],
            "pieces": of_model,
            **{key: document[key] for key in ("contexts", "features", "tokens")},
            "stores": {key: stores[key] for key in ("program", "weights")},
            "files": {name: digest for name, digest in hashes.items() if name in read},
        }
    )
    precision = {k: v for k, v in (document["precision"] or {}).items() if k != "asked"}
    whole = {
        "model": model_identity,
        "pieces": {name: piece for name, piece in pieces.items() if name not in of_model},
        "plans": {n: {k: v for k, v in plan.items() if k not in _TOLD} for n, plan in document["plans"].items()},
        **{key: document[key] for key in ("default_plan", "loop_pruners", "starts", "weights")},
        "precision": precision,
        "stores": stores,
        "files": hashes,
    }
    return _checksum(whole), model_identity


_GOLDEN = ("golden", "golden_plans")
_TOLD = ("sparsity", "flops_sparsity")
"""Of a plan what people are told and no action depends on."""


def _check_plans(manifest: Manifest, fields: Mapping[str, Value]) -> None:
    """Everything that plans and starts name is there."""
    others = (ORIGINAL, *manifest.spec.loops)
    for name, start in manifest.starts.items():
        value = fields["starts"].members()[name]
        if name in others or start.loop not in others:
            value.fail(f"another name than the loops {list(others)}, and the last steps of one of these")
        if start.steps >= manifest.sampler_of(start.loop).steps:
            value.fail(f"fewer steps than the {manifest.sampler_of(start.loop).steps} of loop {start.loop!r}")
    for name, plan in manifest.plans.items():
        if fault := plan_fault(manifest, plan):
            fields["plans"].members()[name].fail(fault)


def plan_fault(manifest: Manifest, plan: PlanRecord) -> str | None:
    """What was expected of the fields of a plan and is not so; None where all that it names is there."""
    if plan.loop not in manifest.loops:
        return f"a loop, one of {list(manifest.loops)}"
    if plan.weights not in (ORIGINAL, *manifest.weights):
        return f"weights, one of {[ORIGINAL, *manifest.weights]}"
    if not plan.precision.items() <= manifest.held.items():
        return f"parts in the precision that the artifact has models in, {manifest.held or 'none'}"
    if plan.tokens is not None and not manifest.tokens:
        return "no reuse of tokens, because no frame piece has tokens"
    if plan.tokens is not None and plan.tokens.scene is not None and names.SCENE not in manifest.tokens:
        return "no reuse of a scene's tokens, because it has none"
    if (plan.otherwise is not None) != (plan.loop in manifest.starts):
        return "another plan for calls without a chunk exactly where the loop begins with one"
    other = manifest.plans.get(plan.otherwise or DENSE)
    if plan.otherwise not in (None, DENSE) and (other is None or other.loop in manifest.starts):
        return "a plan for calls without a chunk whose loop begins with noise"
    loop = manifest.whole_loop(plan.loop)
    if loop != plan.loop and loop != (ORIGINAL if other is None else other.loop):
        return f"a plan for calls without a chunk in loop {loop!r}, whose last steps these are"
    return None


# C901, PLR0912: a condition for each part
def _check_parts(manifest: Manifest, fields: Mapping[str, Value]) -> None:  # noqa: C901, PLR0912
    blocks = len(manifest.blocks)
    if len(manifest.flops.blocks) != blocks:
        fields["flops"].fail(f"FLOPs of {blocks} blocks")
    wanted = {names.CONDITION, names.STEM, names.ADVANCE, *names.OF_ALL_BLOCKS, *map(names.block_name, range(blocks))}
    if missing := wanted - set(manifest.pieces):
        fields["pieces"].fail(f"the pieces {sorted(missing)} too")
    for name, piece in manifest.pieces.items():
        if piece.stream is not None and piece.stream not in piece.inputs:
            fields["pieces"].members()[name].members()["stream"].fail(f"one of {', '.join(map(repr, piece.inputs))}")
        if not set(piece.contexts) <= set(manifest.contexts):
            fields["pieces"].fail(f"contexts of {name} that are among {list(manifest.contexts)}")
    # The pruner may read what no piece of the loop does.
    once = [manifest.pieces[name].outputs for name in (names.SCENE, names.CONDITION) if name in manifest.pieces]
    known = {*manifest.contexts, *chain(*once)}
    if not set(manifest.features) <= known:
        fields["features"].fail(f"some of the contexts {sorted(known)}")
    rows = manifest.pieces[names.FRAMES].outputs if names.FRAMES in manifest.pieces else ()
    read = [name for piece in names.frame_pieces(manifest.pieces) for name in manifest.pieces[piece].inputs]
    if sorted(read) != sorted(rows):
        fields["pieces"].fail(f"frame pieces that read {sorted(rows)}, each once")
    _check_tokens(manifest, fields)
    has_pruner = names.PRUNER in manifest.pieces
    wanted = {names.of_loop(names.PRUNER, loop) for loop in manifest.loop_pruners}
    if wanted != {name for name in manifest.pieces if name.startswith(names.of_loop(names.PRUNER, ""))}:
        fields["loop_pruners"].fail("a file for each pruner of a further loop")
    if has_pruner != (manifest.stores.pruner is not None):
        fields["stores"].fail("a file of pruner weights exactly when there is a piece called pruner")
    if not has_pruner and any(plan.pruned for plan in manifest.plans.values()):
        fields["plans"].fail("no plan of the kind pruner, because there is no piece called pruner")
    if manifest.stores.plans is None and any(plan.kind == "schedule" for plan in manifest.plans.values()):
        fields["stores"].fail("a file of plans, because there are schedules")
    if DENSE in manifest.plans:
        fields["plans"].fail("no plan called 'dense', which every artifact has")
    if manifest.default_plan not in {DENSE, *manifest.plans}:
        fields["default_plan"].fail(f"one of {[DENSE, *manifest.plans]}")


def _check_tokens(manifest: Manifest, fields: Mapping[str, Value]) -> None:
    """What has tokens has its two pieces, which fit it and what is kept; and there are no others."""
    known = {*names.frame_pieces(manifest.pieces), *{names.SCENE} & set(manifest.pieces)}
    if not set(manifest.tokens) <= known:
        fields["tokens"].fail(f"some of the pieces {sorted(known)}")
    wanted = [make(name) for name in manifest.tokens for make in (names.pixels_name, names.tokens_name)]
    if sorted(wanted) != sorted(filter(names.of_tokens, manifest.pieces)):
        fields["pieces"].fail(f"for the sake of tokens exactly {sorted(wanted)}")
    for name, record in manifest.tokens.items():
        own = (name, names.pixels_name(name), names.tokens_name(name))
        frame, pixels, part = (manifest.pieces[piece] for piece in own)
        rows, read = [kind.at(1)[:1] for kind in record.kept.values()], set(frame.inputs)
        if [*record.words] != sorted({word for word in record.words if word < record.tokens}):
            told = f"some of the numbers 0..{record.tokens - 1}, ascending"
            fields["tokens"].members()[name].members()["words"].fail(told)
        fits = set(pixels.inputs) <= read and pixels.outputs == (names.PIXELS,) and 0 <= record.fixed < record.tokens
        # In an older artifact each row goes to its own token, so the piece is not told where.
        beside = names.NOT_KEPT if names.PLACES in part.inputs else (names.PIXELS, names.INDEX)
        known_inputs = {*beside, *record.kept}
        fits = fits and known_inputs <= set(part.inputs) <= known_inputs | read
        renewed = tuple(map(names.renewed_name, record.kept))
        if not fits or part.outputs[len(frame.outputs) :] != renewed or set(rows) != {(record.tokens,)}:
            fields["tokens"].members()[name].fail("what the pieces of its tokens read and give")


def _uses(manifest: Manifest) -> Counter[str]:
    """How often each file is named; by pieces, stores and pruners once."""
    common = {piece.file for piece in manifest.pieces.values()} | set(manifest.loop_pruners.values())
    uses = Counter(common | {name for name in vars(manifest.stores).values() if name})
    if manifest.precision is not None:
        own = manifest.precision
        uses.update((own.weights, *own.models.values(), *([own.fp32] if own.fp32 else ())))
    for one in manifest.weights.values():
        uses.update((one.weights, *one.models.values(), *one.precision_models.values()))
        uses.update([one.precision_weights] if one.precision_weights else [])
    return uses


def _require_alone(value: Value, files: Iterable[str], uses: Mapping[str, int]) -> None:
    if any(uses[name] > 1 for name in files):
        value.fail("a file for each model and one for the weights, which nothing else uses")


def _check_precision(manifest: Manifest, record: PrecisionRecord, value: Value, uses: Mapping[str, int]) -> None:
    blocks = set(map(names.block_name, range(len(manifest.blocks))))
    known = {piece for piece in manifest.pieces if names.part_of(piece) is not None} | blocks
    models = set(record.models)
    if not models or not models <= known:
        value.fail(f"models of some of {', '.join(sorted(known))} and of nothing else")
    if (all_blocks := set(names.OF_ALL_BLOCKS) & models) and not blocks & models:
        value.fail(f"models of some blocks beside {' and '.join(sorted(all_blocks))}")
    if blocks & models and len(all_blocks) < len(names.OF_ALL_BLOCKS):
        value.fail(f"models called {' and '.join(names.OF_ALL_BLOCKS)} too")
    if not set(record.asked) <= {names.part_of(piece) for piece in known} - {names.part_of(piece) for piece in models}:
        value.fail("parts of the policy that none of its models belongs to, as those that stay fp32")
    _require_alone(value, record.files, uses)


def _check_weights(manifest: Manifest, record: WeightsRecord, value: Value, uses: Mapping[str, int]) -> None:
    known = {*map(names.block_name, range(len(manifest.blocks))), *names.OF_ALL_BLOCKS}
    if set(record.models) != known:
        value.fail(f"a model of each of {', '.join(sorted(known))}")
    other = manifest.precision
    lower = set() if other is None else set(other.models) & known
    if set(record.precision_models) != lower or (record.precision_weights is None) is bool(lower):
        value.fail(f"models in another precision, and a file of their weights, for {sorted(lower) or 'nothing'}")
    _require_alone(value, record.files, uses)


_SCORE = ("distance", "error", "error_p90", "of_other_noise", "sparsity", "flops_sparsity", "flops_saved", "tokens")
_BUDGET = ("target_sparsity", "target_flops", "latency_ms", "max_action_error", "max_distance")
_RECORD: Mapping[str, Any] = {
    "strategy": str,  # in records of before; ``learned`` says it now
    "seed": int,
    "learned": tuple[str, ...],
    "plans": Mapping[str, Mapping[str, Any]],
    "budget": Mapping[str, Any],
    "other_noise": float | None,
    "policy_hz": Hertz | None,
    "episodes": Mapping[str, tuple[int, ...]],
    "calls": Mapping[str, int],
    "skipped": Mapping[str, str],
    "told": Mapping[str, str],
    "frontier": tuple[Mapping[str, Any], ...],
    "timed_on": str | None,
}
_TRIED: Mapping[str, Any] = {
    "name": str,
    "told": str,
    "distance": float,
    "interval": tuple[float, ...],
    "milliseconds": float,
    "worst": float,
    "near": bool,
    "within": float,
    "calls": int,
    "weights": int,
}


def check_record(record: Value) -> None:
    """Raise ArtifactError unless what commands read of a calibration record is of its type; the rest is free JSON."""
    members = record.members()
    _check_kinds(members, _RECORD)
    if "budget" in members:
        _check_kinds(members["budget"].members(), dict.fromkeys(_BUDGET, float | None))
    for score in members["plans"].members().values() if "plans" in members else ():
        _check_kinds(score.members(), {**dict.fromkeys(_SCORE, float | None), "interval": tuple[float, ...]})
    for tried in members["frontier"].items() if "frontier" in members else ():
        _check_kinds(tried.members(), _TRIED)


def _check_kinds(members: Mapping[str, Value], kinds: Mapping[str, Any]) -> None:
    for name in members.keys() & kinds.keys():
        typed_json.read_as(kinds[name], members[name])


def _checksum(document: object) -> str:
    return hashlib.sha256(dump_compact(document)).hexdigest()
