"""Write an artifact, and update its calibration: all of it or nothing, and the same inputs give the same bytes."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.coercion import Array, Arrays
from ..core.envelope import Envelope
from ..core.paths import require_free_or_path
from ..core.plan import DENSE, FULL, ORIGINAL, Plan
from ..errors import ArtifactError
from ..ir.pieces import ADVANCE, PRUNER, of_loop
from ..ir.program import Binding, Program
from ..ir.verify import verify_pieces
from ..measure.versions import VERSION
from . import files, records, stores, tensors
from .bind import LoweredPieces, Place, bind, places_of, read_in_fp32, store_pieces
from .codec import decode, encode, identities
from .files import locked
from .golden import Golden, GoldenPlan, plan_arrays
from .graph_json import graph_to_json
from .load import Artifact, load_artifact, read_manifest, require_artifact_path, table_prefix
from .manifest import FORMAT, MANIFEST, SCHEMA_VERSION, Manifest, PlanRecord, StartRecord, Stores, abbreviated
from .strict_json import dump_compact

if TYPE_CHECKING:
    from onnx import ModelProto

PROGRAM, TOKENIZER = "program.json", "tokenizer.json"
WEIGHTS, WEIGHTS_FP32 = "weights.safetensors", "weights_fp32.safetensors"
GOLDEN = "golden.safetensors"

_STALE = re.compile(
    rf"(pruner-[0-9a-f]+\.(onnx|safetensors)|(golden_)?plans-[0-9a-f]+\.safetensors"
    rf"|(blocks|distilled)-[0-9a-f]+-[A-Za-z0-9_]+\.(onnx|safetensors)|\..+{re.escape(files.PARTIAL)})"
)
BESIDE = ("config.json", "policy_preprocessor.json", "policy_postprocessor.json")
"""Files for LeRobot that may stand in an artifact. Nothing here reads them, the manifest does not list them, and no
identity covers them."""

_BESIDE = "|".join(map(re.escape, (TOKENIZER, *BESIDE)))
_OURS = re.compile(rf"manifest\.json|program\.json|{_BESIDE}|[A-Za-z0-9_-]+\.(onnx|safetensors)|{_STALE.pattern}")


def write_artifact(
    program: Program,
    models: Mapping[str, ModelProto],
    directory: str | os.PathLike[str],
    lowered: LoweredPieces | None = None,
    golden: Golden | None = None,
    beside: Mapping[str, bytes] | None = None,
    loop: str = ORIGINAL,
    tokenizer: bytes | None = None,
) -> Manifest:
    """Write a compiled program.

    Its default plan is ``dense``, or where another loop or precision is asked for ``full``, which computes every cell
    of that loop in that precision; until it is calibrated.

    Args:
        program: after all passes.
        models: from ``lower_program``.
        directory: where it goes; its parents are made. Everything is written to a folder beside it, which then takes
            the place of an artifact that is there.
        lowered: pieces of another precision, which plan ``full`` takes; None for fp32 alone.
        golden: what the original network answered; None leaves the artifact without, which then cannot be verified.
        beside: files for other programs, by name, one of ``BESIDE``.
        loop: of plan ``full``.
        tokenizer: content of ``tokenizer.json``, of a policy that is told its task in words; None without.

    Raises:
        ArtifactError: ``directory`` is something else than an artifact, or cannot be written; or program and models do
            not fit each other. Nothing is changed then.
        PassError: the program's parts do not fit each other (``ir.verify``).
    """
    target = Path(os.path.realpath(directory))
    with replacing(target) as put, files.writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with files.new_folder(target) as partial:
            manifest = _fill(partial, program, models, lowered, golden, loop, tokenizer)
            for name, content in (beside or {}).items():
                assert name in BESIDE
                files.write_synced(partial / name, content)
            files.sync_directory(partial)
            learned = learned_plans(target)
            put(partial)
    if learned:
        told = f"had {len(learned)} learned plan{'s' * (len(learned) > 1)} ({', '.join(learned)}); the new one has none"
        warnings.warn(f"{target}: the artifact there {told}: calibrate it again.", stacklevel=2)
    return manifest


@contextmanager
def replacing(target: Path) -> Iterator[Callable[[Path], None]]:
    """Keep others from an artifact, if there is one, until it is replaced by the folder that is given."""
    require_replaceable(target)
    with files.writing(target):
        files.recover(target)
    with ExitStack() as held:
        held.enter_context(locked(target) if target.is_dir() else nullcontext())

        def put(folder: Path) -> None:
            held.close()  # what is there by now may be another folder, and somebody's
            require_replaceable(target)
            with files.writing(target), locked(target) if target.is_dir() else nullcontext():
                files.replace_folder(folder, target)

        yield put


def learned_plans(directory: Path) -> list[str]:
    """Names of the plans of an artifact that a calibration made; none where nothing can be read."""
    with suppress(OSError, ArtifactError):
        found = read_manifest(directory)
        return [name for name in found.plans if found.calibration is not None and name != FULL]
    return []


def update_plans(
    path: str | os.PathLike[str],
    plans: Mapping[str, Plan],
    default_plan: str,
    record: Mapping[str, Any] | None = None,
    *,
    pruner_weights: Arrays | None = None,
    pruner_loop: str = ORIGINAL,
    weights: Mapping[str, stores.BlockWeights] | None = None,
    starts: Mapping[str, StartRecord] | None = None,
    envelope: Envelope | None = None,
    model_identity: str | None = None,
    golden: Callable[[Artifact], Mapping[str, GoldenPlan]] | None = None,
    held: bool = False,
) -> Manifest:
    """Replace the plans of an artifact, and what they name: at once, or not at all.

    Afterwards the artifact has exactly these plans, beside ``dense``. Weights and starts that no plan names any more
    are gone. To keep what is there, pass ``artifact.plans``.

    Args:
        plans: by name; ``dense`` may be among them, and is as it was.
        default_plan: what a call has that is given no plan.
        record: what was done to get here, JSON; ``record["plans"]`` has ``sparsity`` and ``flops_sparsity`` of plans
            that the pruner makes, by name. None keeps the record that is there.
        pruner_weights: all constants of a pruner, by name; None leaves them.
        pruner_loop: the loop whose pruner has these.
        weights: of blocks, which these plans name, by name; those that are there need not be given again.
        starts: loops that begin with the chunk of the call before, by name; likewise.
        envelope: of what the corrections of these plans were fitted on; None keeps the one that is there.
        model_identity: of the artifact that was calibrated; refuses another one.
        golden: records what the reference runtime makes of the plans (``record_golden.record_plans``), given the
            artifact as it will be; None leaves the artifact without, and its plans cannot be verified.
        held: whether the caller has the artifact ``locked``.

    Raises:
        ArtifactError: no artifact, a zipped one, one that is being updated, or arguments that do not fit it.
        IllegalPlanError: a plan or a correction that does not fit the policy.
    """
    directory = require_unzipped(path)
    with nullcontext() if held else locked(directory):
        artifact = load_artifact(directory)
        if model_identity not in (None, artifact.manifest.model_identity):
            raise ArtifactError(
                f"{directory}: expected the model {abbreviated(str(model_identity))}, which was calibrated; found"
                f" {abbreviated(artifact.manifest.model_identity)}: the artifact was converted again. Calibrate it"
                " again."
            )
        told = artifact.manifest.calibration if record is None else records.calibration_record(record)
        try:
            manifest = _store_named(artifact, plans, weights or {}, starts or {})
            manifest = replace(manifest, plans=records.plan_records(manifest, plans, told or {}))
            if default_plan not in {DENSE, *manifest.plans}:
                raise ArtifactError(f"default plan {default_plan!r}: expected one of {[DENSE, *manifest.plans]}.")
            manifest = replace(manifest, default_plan=default_plan, calibration=told)
            manifest = stores.store_arrays(
                directory, manifest, "plans", stores.plan_arrays_of(manifest, plans, envelope or artifact.envelope)
            )
            trained = {**artifact.block_weights, **{name: own.weights for name, own in (weights or {}).items()}}
            pruners = dict(artifact.pruners)
            if pruner_weights is not None:
                own = pruner_loop if pruner_loop in pruners else ORIGINAL
                manifest = stores.store_pruner(artifact, manifest, pruner_weights, own)
                pruners[own] = pruner_weights
            after = replace(
                artifact,
                block_weights={name: trained[name] for name in manifest.weights},
                manifest=manifest,
                plans={DENSE: artifact.plans[DENSE], **{n: replace(plans[n], repair=True) for n in manifest.plans}},
                pruners=pruners,
            )
            manifest = stores.store_arrays(
                directory, manifest, "golden_plans", {} if golden is None else plan_arrays(golden(after))
            )
            manifest, content = finished(manifest)
            files.replace_file(directory / MANIFEST, content)
        except OSError as error:
            raise ArtifactError(
                f"{directory}: cannot be updated: {error}. It has its old plans or the new ones, whole."
            ) from error
        finally:
            _remove_stale(directory)
    return manifest


def choose_default(
    path: str | os.PathLike[str],
    name: str,
    record: Mapping[str, Any],
    precision: Mapping[str, str] | None,
    seen: Artifact,
) -> Manifest:
    """Make a plan of the artifact as it was ``seen`` the default, with another precision if one is given."""
    directory = require_unzipped(path)
    with locked(directory):
        manifest = read_manifest(directory)
        if manifest.identity != seen.manifest.identity:
            raise ArtifactError(f"{directory}: it was replaced meanwhile, and was not changed. Try again.")
        own = manifest.plans[name]
        plans = {**manifest.plans, name: own if precision is None else replace(own, precision=precision)}
        told = records.calibration_record(record)
        manifest, content = finished(replace(manifest, plans=plans, default_plan=name, calibration=told))
        try:
            files.replace_file(directory / MANIFEST, content)
        except OSError as error:
            raise ArtifactError(f"{directory}: cannot be updated: {error}. It is as it was.") from error
    return manifest


def _store_named(
    artifact: Artifact,
    plans: Mapping[str, Plan],
    weights: Mapping[str, stores.BlockWeights],
    starts: Mapping[str, StartRecord],
) -> Manifest:
    """The manifest with the weights and starts that plans name, and no others."""
    manifest, loops = artifact.manifest, {plan.loop for plan in plans.values()}
    named = {plan.weights for plan in plans.values()}
    manifest = stores.without_weights(manifest, named - set(weights))
    for name, own in weights.items():
        manifest = stores.store_weights(artifact, manifest, name, own)
    return replace(manifest, starts={n: one for n, one in {**manifest.starts, **starts}.items() if n in loops})


def _fill(
    folder: Path,
    program: Program,
    models: Mapping[str, ModelProto],
    lowered: LoweredPieces | None,
    golden: Golden | None,
    loop: str,
    tokenizer: bytes | None,
) -> Manifest:
    verify_pieces(program)
    graphs = program.pieces.graphs()
    read = sorted({name for graph in graphs.values() for name in graph.constants})
    values: dict[str, Array] = {name: program.weights[name] for name in read}
    contexts, requires = records.context_records(program), records.requirements(models)
    # The names of loops need not be names of files.
    numbered = {of_loop(ADVANCE, of): f"{ADVANCE}_{i:02d}" for i, of in enumerate(program.spec.loops, start=1)}
    onnx_files = {name: f"{numbered.get(name, name)}.onnx" for name in models}

    pruner = {name: value for name, value in values.items() if name.startswith(records.PRUNER_PREFIX)}
    stored = {name: value for name, value in values.items() if name not in pruner}
    own_rows = [name for name, context in contexts.items() if context.binding is Binding.TABLE]
    loops = {ORIGINAL: program.pieces.tables, **program.pieces.loop_tables}
    tables = {table_prefix(of) + name: rows[name] for of, rows in loops.items() for name in own_rows}
    apart = {} if lowered is None else read_in_fp32(stored, models, lowered)
    common = {name: value for name, value in stored.items() if name not in apart}
    tensors.write(folder / WEIGHTS, {**common, **tables}, short=True)
    places = places_of(folder / WEIGHTS, common)
    if apart:
        tensors.write(folder / WEIGHTS_FP32, apart, short=True)
        places |= places_of(folder / WEIGHTS_FP32, apart)
    pruner_files, pruner_places = dict[str, str](), dict[str, dict[str, Place]]()
    own = {PRUNER: pruner} if PRUNER in graphs else {}
    further = {of_loop(PRUNER, loop): program.loop_weights[loop] for loop in program.pieces.loop_pruners}
    for piece, constants in {**own, **further}.items():
        content = tensors.serialize(constants)
        name = stores.pruner_name(piece, content)
        pruner_files[piece], onnx_files[piece] = f"{name}.safetensors", f"{name}.onnx"
        files.write_synced(folder / pruner_files[piece], content)
        pruner_places[piece] = places_of(folder / pruner_files[piece], constants)

    pieces = records.piece_records(program, models, onnx_files)
    for name in pieces:
        files.write_synced(folder / onnx_files[name], bind(models[name], places | pruner_places.get(name, {}), name))
    precision = None if lowered is None else store_pieces(folder, lowered, pieces, places)
    if precision is not None and apart:
        precision = replace(precision, fp32=WEIGHTS_FP32)
    plans = dict[str, PlanRecord]()
    if precision is not None or loop != ORIGINAL:
        held = {} if precision is None else dict.fromkeys(precision.kept, precision.name)
        plans[FULL] = PlanRecord("all", loop=loop, precision=held)
    if golden is not None:
        files.write_synced(folder / GOLDEN, tensors.serialize(golden.arrays()))
    if tokenizer is not None:
        files.write_synced(folder / TOKENIZER, tokenizer)
    graphs |= {of_loop(PRUNER, loop): graph for loop, graph in program.pieces.loop_pruners.items()}
    document = {
        "graphs": {name: graph_to_json(graph) for name, graph in graphs.items()},
        "streams": {name: piece.stream for name, piece in program.pieces.loop.items()},
    }
    files.write_synced(folder / PROGRAM, dump_compact(document))

    manifest, content = finished(
        Manifest(
            schema_version=SCHEMA_VERSION,
            ttscompile_version=VERSION,
            identity="",
            model_identity="",
            spec=program.spec,
            blocks=records.block_records(program),
            pieces=pieces,
            contexts=contexts,
            features=program.pieces.features,
            flops=records.flops_record(program),
            plans=plans,
            default_plan=FULL if plans else DENSE,
            calibration=None,
            stores=Stores(
                PROGRAM,
                WEIGHTS,
                pruner_files.pop(PRUNER, None),
                None,
                golden=None if golden is None else GOLDEN,
                tokenizer=None if tokenizer is None else TOKENIZER,
            ),
            requires=requires,
            files={path.name: files.describe(path) for path in sorted(folder.iterdir())},
            precision=precision,
            loop_pruners={loop: pruner_files[of_loop(PRUNER, loop)] for loop in program.pieces.loop_pruners},
            tokens=records.tokens_records(program),
        )
    )
    files.write_synced(folder / MANIFEST, content)
    return manifest


def require_unzipped(path: str | os.PathLike[str]) -> Path:
    """The directory of an artifact that is about to be changed. Raises ArtifactError: no artifact, or a zipped one."""
    directory = Path(path)
    require_artifact_path(directory)
    if not directory.is_dir():
        raise ArtifactError(f"{directory}: expected a directory; found a file. Unzip it and give the directory.")
    return directory


def finished(manifest: Manifest) -> tuple[Manifest, bytes]:
    """The manifest with the identities of what it describes, and its bytes; refuses what nobody could load."""
    identity, model_identity = identities(manifest)
    content = encode(replace(manifest, identity=identity, model_identity=model_identity))
    return decode(content), content


def require_replaceable(directory: str | os.PathLike[str]) -> None:
    """Raise unless a directory is free, empty, or an artifact and nothing else: users' files are never removed."""
    require_free_or_path(directory, ArtifactError, "Give another output directory.")
    target = Path(os.path.realpath(directory))
    if not target.exists():
        return
    if not target.is_dir():
        raise ArtifactError(f"{target}: expected a directory, or nothing; found a file. Give another output directory.")
    entries = sorted(path.name for path in target.iterdir())
    foreign = [name for name in entries if _OURS.fullmatch(name) is None]
    manifest = target / MANIFEST
    ours = MANIFEST in entries and not foreign and FORMAT.encode() in manifest.read_bytes()[:256]
    if entries and not ours:
        raise ArtifactError(
            f"{target}: expected an empty directory or a ttscompile artifact; found one that holds"
            f" {', '.join((foreign or entries)[:5])}. Give another output directory, or remove this one yourself."
        )
    with locked(target):  # told now, not after minutes of work
        pass


def _remove_stale(directory: Path) -> None:
    """Remove what an update left behind: files of its kinds that the manifest on disk does not list."""
    with suppress(OSError, ArtifactError):  # they are in nobody's way, and the next update tries again
        kept = read_manifest(directory).files
        for path in directory.iterdir():
            if _STALE.fullmatch(path.name) and path.name not in kept:
                path.unlink()
