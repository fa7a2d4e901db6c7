"""Write an artifact, and update its calibration: all of it or nothing, and the same inputs give the same bytes."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..correction import Correction
from ..errors import ArtifactError
from ..ir.program import Binding, Program
from ..ir.serialize import graph_to_json
from ..lattice import plan_flops, sparsity
from . import tensors
from .bind import Place, bind, rebind
from .codec import encode
from .files import PARTIAL, beside, content_hash, describe, replace_file, sync_directory, write_synced
from .identity import identities
from .load import (
    CORRECTION_FIELDS,
    CORRECTION_PREFIX,
    TABLE_PREFIX,
    Artifact,
    check_schedule,
    load_artifact,
    read_manifest,
)
from .manifest import DENSE, FORMAT, MANIFEST, SCHEMA_VERSION, Manifest, PlanRecord, Stores
from .precision import LoweredBlocks, store_blocks
from .records import (
    PRUNER_PREFIX,
    block_records,
    constants,
    context_records,
    flops_record,
    piece_graphs,
    piece_records,
    requirements,
)
from .strict_json import Value, dump_compact, parse

if TYPE_CHECKING:
    from onnx import ModelProto

PROGRAM = "program.json"
WEIGHTS = "weights.safetensors"
PRUNER = "pruner"
"""Name of the pruner's piece, and of its plan where ``default_plan`` gives none."""

_STALE = re.compile(rf"(pruner-[0-9a-f]+\.(onnx|safetensors)|plans-[0-9a-f]+\.safetensors|\..+{re.escape(PARTIAL)})")
_OURS = re.compile(rf"manifest\.json|program\.json|[A-Za-z0-9_-]+\.(onnx|safetensors)|{_STALE.pattern}")
_PLAN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.%-]{0,63}")


def write_artifact(
    program: Program,
    models: Mapping[str, ModelProto],
    directory: str | os.PathLike[str],
    blocks: LoweredBlocks | None = None,
) -> Manifest:
    """Write a compiled program; its default plan is ``dense`` until it is calibrated.

    Everything is written to a folder beside ``directory``, which then takes its place.

    Args:
        program: after all passes.
        models: from ``lower_program``.
        directory: where it goes; its parents are made. An artifact that is there is replaced.
        blocks: residual blocks of another precision, which then is the artifact's; None for fp32.

    Returns:
        The manifest.

    Raises:
        ArtifactError: ``directory`` is something else than an artifact, or cannot be written; or program and models do
            not fit each other. Nothing is changed then.
    """
    target = Path(os.path.realpath(directory))
    _require_replaceable(target)
    partial = beside(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with _locked(target) if target.is_dir() else nullcontext():
            partial.mkdir()
            manifest = _fill(partial, program, models, blocks)
            sync_directory(partial)
            _install(partial, target)
    except OSError as error:
        raise ArtifactError(
            f"{target}: the artifact cannot be written: {error}. What was there is unharmed."
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)  # gone already if all went well
    return manifest


def update_calibration(
    path: str | os.PathLike[str],
    pruner_weights: Mapping[str, npt.NDArray[Any]] | None,
    schedules: Mapping[str, npt.NDArray[np.int8]],
    default_plan: str,
    record: Mapping[str, Any],
    *,
    corrections: Mapping[str, Correction] | None = None,
    model_identity: str | None = None,
) -> Manifest:
    """Replace the plans of an artifact, and its pruner's weights: at once, or not at all.

    Afterwards the artifact has exactly these schedules and, if ``pruner_weights`` are given, one plan of the pruner.
    That plan has the name ``default_plan``, or ``pruner`` where ``default_plan`` is a schedule or ``dense``; its
    sparsities are ``record["sparsity"]`` and ``record["flops_sparsity"]`` if the record has them. To keep what is
    there, pass ``artifact.pruner`` and ``artifact.schedules``.

    Args:
        path: the artifact's directory.
        pruner_weights: all constants of the pruner, by name; None leaves them and drops the pruner's plan.
        schedules: int8 ``[K, blocks]`` by name.
        default_plan: what ``predict_action`` uses when it is given no plan.
        record: what was done to get here; JSON.
        corrections: of the sampler's steps, by the name of their plan; None for none.
        model_identity: of the artifact that was calibrated; refuses another one.

    Returns:
        The new manifest.

    Raises:
        ArtifactError: no artifact, a zipped one, one that is being updated, or arguments that do not fit it.
        IllegalPlanError: a schedule or a correction that does not fit the policy.
    """
    directory = Path(path)
    if directory.is_file():
        raise ArtifactError(f"{directory}: expected a directory; found a file. Unzip it and give the directory.")
    if not directory.is_dir():
        raise ArtifactError(f"{directory}: does not exist. Give the directory that 'ttscompile convert' wrote.")
    with _locked(directory):
        artifact = load_artifact(directory)
        if model_identity not in (None, artifact.manifest.model_identity):
            raise ArtifactError(
                f"{directory}: expected the model {str(model_identity)[:12]}, which was calibrated; found"
                f" {artifact.manifest.model_identity[:12]}: the artifact was converted again. Calibrate it again."
            )
        manifest = replace(
            artifact.manifest,
            plans=_plan_records(artifact.manifest, pruner_weights is not None, schedules, default_plan, record),
            default_plan=default_plan,
            calibration=_json(record),
        )
        try:
            manifest = _store_plans(directory, manifest, schedules, corrections or {})
            if pruner_weights is not None:
                manifest = _store_pruner(artifact, manifest, pruner_weights)
            manifest = _identified(manifest)
            replace_file(directory / MANIFEST, encode(manifest))
        except OSError as error:
            raise ArtifactError(
                f"{directory}: cannot be updated: {error}. It has its old plans or the new ones, whole."
            ) from error
        finally:
            _remove_stale(directory)
    return manifest


def _fill(folder: Path, program: Program, models: Mapping[str, ModelProto], blocks: LoweredBlocks | None) -> Manifest:
    """Write all files of a new artifact into an empty folder."""
    graphs = piece_graphs(program)
    values = constants(program, graphs)
    contexts = context_records(program, graphs)
    requires = requirements(models)
    files = {name: f"{name}.onnx" for name in models}

    pieces_tables = {} if program.pieces is None else program.pieces.tables
    pruner = {name: value for name, value in values.items() if name.startswith(PRUNER_PREFIX)}
    stored = {name: value for name, value in values.items() if name not in pruner}
    tables = {TABLE_PREFIX + n: pieces_tables[n] for n, c in contexts.items() if c.binding is Binding.TABLE}
    write_synced(folder / WEIGHTS, tensors.serialize({**stored, **tables}))
    places = _places(folder / WEIGHTS, stored)
    pruner_file = None
    if PRUNER in graphs:
        content = tensors.serialize(pruner)
        pruner_file, files[PRUNER] = _pruner_names(content)
        write_synced(folder / pruner_file, content)
        places.update(_places(folder / pruner_file, pruner))

    pieces = piece_records(graphs, models, files)
    for name in pieces:
        write_synced(folder / files[name], bind(models[name], places, name).SerializeToString(deterministic=True))
    precision = None if blocks is None else store_blocks(folder, blocks, pieces, places)
    document = {"graphs": {name: graph_to_json(graph) for name, graph in graphs.items()}}
    write_synced(folder / PROGRAM, dump_compact(document))

    manifest = _identified(
        Manifest(
            schema_version=SCHEMA_VERSION,
            ttscompile_version=__version__,
            identity="",
            model_identity="",
            spec=program.spec,
            blocks=block_records(program),
            reuse=program.reuse,
            pieces=pieces,
            contexts=contexts,
            features=() if program.pieces is None else program.pieces.features,
            flops=flops_record(program),
            plans={},
            default_plan=DENSE,
            calibration=None,
            stores=Stores(program=PROGRAM, weights=WEIGHTS, pruner=pruner_file, plans=None),
            requires=requires,
            files={path.name: describe(path) for path in sorted(folder.iterdir())},
            precision=precision,
        )
    )
    write_synced(folder / MANIFEST, encode(manifest))
    return manifest


def _places(path: Path, values: Mapping[str, npt.NDArray[Any]]) -> dict[str, Place]:
    offsets = tensors.offsets(path)
    return {name: Place(value, path.name, *offsets[name]) for name, value in values.items()}


def _pruner_names(content: bytes) -> tuple[str, str]:
    """Names of the pruner's weights and of its ONNX model, by the content of the weights."""
    digits = content_hash(content)
    return f"{PRUNER}-{digits}.safetensors", f"{PRUNER}-{digits}.onnx"


def _identified(manifest: Manifest) -> Manifest:
    identity, model_identity = identities(manifest)
    return replace(manifest, identity=identity, model_identity=model_identity)


def _require_replaceable(target: Path) -> None:
    """Raise unless the target is free, empty, or an artifact and nothing else: users' files are never removed."""
    if not target.exists():
        return
    if not target.is_dir():
        raise ArtifactError(f"{target}: expected a directory, or nothing; found a file. Give another output directory.")
    entries = sorted(path.name for path in target.iterdir())
    foreign = [name for name in entries if _OURS.fullmatch(name) is None]
    if entries and (foreign or MANIFEST not in entries or FORMAT.encode() not in _start(target / MANIFEST)):
        raise ArtifactError(
            f"{target}: expected an empty directory or a ttscompile artifact; found one that holds"
            f" {', '.join((foreign or entries)[:5])}. Give another output directory, or remove this one yourself."
        )


def _start(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(256)


def _install(partial: Path, target: Path) -> None:
    """Put the finished folder in its place; an artifact that was there comes back if that fails."""
    if not target.exists():
        partial.replace(target)
        sync_directory(target.parent)
        return
    old = beside(target)
    target.replace(old)
    try:
        partial.replace(target)
    except BaseException:
        old.replace(target)
        raise
    shutil.rmtree(old, ignore_errors=True)
    sync_directory(target.parent)


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Keep other processes from changing the artifact; a crash releases it."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ArtifactError(
                f"{directory}: another process is changing the artifact. Try again when it is done."
            ) from None
        yield
    finally:
        os.close(descriptor)


def _plan_records(
    manifest: Manifest,
    pruned: bool,
    schedules: Mapping[str, npt.NDArray[np.int8]],
    default_plan: str,
    record: Mapping[str, Any],
) -> dict[str, PlanRecord]:
    plans = {}
    for name in sorted(schedules):
        if _PLAN_NAME.fullmatch(name) is None or name == DENSE:
            raise ArtifactError(f"schedule {name!r}: expected letters, digits and _ . % - and not 'dense'.")
        plan = np.asarray(schedules[name])
        check_schedule(name, plan, manifest)
        total = manifest.steps * sum(manifest.flops.blocks)
        weighed = 1 - plan_flops(plan, manifest.flops.blocks) / total if total else sparsity(plan)
        plans[name] = PlanRecord(kind="schedule", sparsity=sparsity(plan), flops_sparsity=weighed)
    if pruned:
        if manifest.stores.pruner is None:
            raise ArtifactError("the artifact has no pruner whose weights could be set. Convert the checkpoint again.")
        name = PRUNER if default_plan in {DENSE, *plans} else default_plan
        if name in plans or _PLAN_NAME.fullmatch(name) is None:
            raise ArtifactError(f"the pruner's plan cannot be called {name!r}. Give the schedule another name.")
        plans[name] = PlanRecord("pruner", _share(record, "sparsity"), _share(record, "flops_sparsity"))
    if default_plan not in {DENSE, *plans}:
        raise ArtifactError(f"default plan {default_plan!r}: expected one of {[DENSE, *plans]}.")
    return plans


def _share(record: Mapping[str, Any], key: str) -> float | None:
    return None if record.get(key) is None else Value(record[key], f"calibration record: {key}").share()


def _json(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record as it will be read back."""
    try:
        content = dump_compact(dict(record))
    except (TypeError, ValueError) as error:
        raise ArtifactError(f"calibration record: expected JSON; found {error}. Convert arrays to lists.") from error
    return {key: value.data for key, value in parse(content, "calibration record").members().items()}


def _store_plans(
    directory: Path,
    manifest: Manifest,
    schedules: Mapping[str, npt.NDArray[np.int8]],
    corrections: Mapping[str, Correction],
) -> Manifest:
    """Write the file of schedules and corrections beside the old one."""
    arrays: dict[str, npt.NDArray[Any]] = dict(schedules)
    for plan, correction in corrections.items():
        if plan not in manifest.plans:
            raise ArtifactError(f"correction of {plan!r}: expected a plan of the artifact, {sorted(manifest.plans)}.")
        correction.require_fit(manifest.steps, manifest.spec.sample)
        arrays |= {f"{CORRECTION_PREFIX}{plan}/{name}": getattr(correction, name) for name in CORRECTION_FIELDS}
    old = manifest.stores.plans
    files = {name: record for name, record in manifest.files.items() if name != old}
    name = None
    if arrays:
        content = tensors.serialize(arrays)
        name = f"plans-{content_hash(content)}.safetensors"
        replace_file(directory / name, content)
        files[name] = describe(directory / name)
    return replace(manifest, files=files, stores=replace(manifest.stores, plans=name))


def _store_pruner(artifact: Artifact, manifest: Manifest, weights: Mapping[str, npt.NDArray[Any]]) -> Manifest:
    """Write the pruner's weights, and its model that refers to them, beside the old ones."""
    import onnx

    expected = {name: (value.shape, value.dtype) for name, value in artifact.pruner.items()}
    values = {name: np.asarray(value) for name, value in weights.items()}
    found = {name: (value.shape, value.dtype) for name, value in values.items()}
    if expected != found:
        wrong = sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name))
        raise ArtifactError(
            f"{artifact.path}: pruner weights: expected {expected.get(wrong[0], 'no')} for {wrong[0]!r}; found"
            f" {found.get(wrong[0], 'none')} ({len(wrong)} differ). Calibrate this artifact again."
        )
    piece = manifest.pieces[PRUNER]
    gone = {piece.file, manifest.stores.pruner}
    content = tensors.serialize(values)
    weights_name, model_name = _pruner_names(content)
    replace_file(artifact.path / weights_name, content)
    model = onnx.load(artifact.path / piece.file, load_external_data=False)
    bound = rebind(model, _places(artifact.path / weights_name, values), PRUNER)
    replace_file(artifact.path / model_name, bound.SerializeToString(deterministic=True))
    files = {name: record for name, record in manifest.files.items() if name not in gone}
    files.update({name: describe(artifact.path / name) for name in (weights_name, model_name)})
    return replace(
        manifest,
        files=files,
        pieces={**manifest.pieces, PRUNER: replace(piece, file=model_name)},
        stores=replace(manifest.stores, pruner=weights_name),
    )


def _remove_stale(directory: Path) -> None:
    """Remove what an update left behind: files of its kinds that the manifest on disk does not list."""
    with suppress(OSError, ArtifactError):  # they are in nobody's way, and the next update tries again
        kept = read_manifest(directory).files
        for path in directory.iterdir():
            if _STALE.fullmatch(path.name) and path.name not in kept:
                path.unlink()
