"""Open an artifact: everything is checked before anything of it is used. Needs numpy alone."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.correction import Correction
from ..core.lattice import PlanArray, Source, check_plan, dense_plan
from ..core.paths import require_path
from ..core.spec import FP32
from ..errors import ArtifactError, IllegalPlanError
from ..ir.graph import Graph
from ..ir.pieces import CONDITION, FRAMES, PRUNER, STEM, STEP, TAIL, LoopPiece, block_name, frame_pieces, part_of
from ..ir.program import Binding, Pieces
from . import tensors
from .archive import Unpacked, is_checkpoint, unpack
from .codec import MAX_MANIFEST_BYTES, decode, identities
from .corrections import PREFIX, read_corrections
from .files import check_file, read_file
from .folder import Folder, Stamp
from .graph_json import graph_from_json
from .manifest import DENSE, DISTILLED, MANIFEST, Manifest, abbreviated
from .onnx_files import check_model
from .requires import check_runtime
from .size import check_size
from .strict_json import REMEDY, Value, parse
from .tokens import ReuseRecord

TABLE_PREFIX = "table/"


@dataclass(frozen=True, eq=False)
class Artifact:
    """An artifact on disk, checked.

    Attributes:
        path: the directory; of a zipped artifact a temporary one, which lives as long as this object.
        manifest: what is not array or graph.
        weights: constants of all pieces but the pruner's, read-only views of the file.
        tables: TABLE contexts ``[K, ...]``, read-only views of the file.
        pruner: constants of the pruner (their names start with ``pruner.``); empty if there is none.
        schedules: int8 ``[K, blocks]`` by name, without ``dense``.
        corrections: of the sampler's steps, by the name of the plan that they belong to.
        distilled: constants that the plan ``distilled`` has in place of those of ``weights``, read-only views of the
            file; empty if there is no such plan.
        first_step: the artifact whose blocks compute step 0, where those are not its own (``with_weights_of``).
        later: names of the constants that blocks have after step 0 only.
    """

    path: Path
    manifest: Manifest
    weights: Mapping[str, npt.NDArray[Any]]
    tables: Mapping[str, npt.NDArray[Any]]
    pruner: Mapping[str, npt.NDArray[Any]]
    schedules: Mapping[str, PlanArray]
    corrections: Mapping[str, Correction]
    distilled: Mapping[str, npt.NDArray[Any]]
    _folder: Folder = field(repr=False)
    _stamps: Mapping[str, Stamp] = field(repr=False)
    _unpacked: Unpacked | None = field(default=None, repr=False)
    first_step: Artifact | None = field(default=None, repr=False)
    later: tuple[str, ...] = ()

    @property
    def files(self) -> Path:
        """The folder to read from, within ``reading``: still the one that was checked when another is at ``path``."""
        return self._folder.files

    @contextmanager
    def reading(self, *names: str) -> Iterator[None]:
        """Within the block these files, in ``files``, are those that were checked.

        Args:
            names: none means all.

        Raises:
            ArtifactChangedError: a file was changed or replaced since it was checked.
        """
        names = names or tuple(self.manifest.files)
        with self._folder.unchanged(names) as now:
            for name in names:
                if now[name] == self._stamps.get(name):
                    continue
                try:
                    check_file(self.files / name, self.manifest.files[name])
                except (ArtifactError, KeyError) as error:  # the manifest itself has no record
                    raise self._folder.changed([name]) from error
            yield

    def onnx_file(self, piece: str) -> str:
        """Name of the ONNX file of a piece, whose weights are beside it; the one in its precision."""
        record = self.manifest.precision
        models = {} if record is None else record.models
        return models.get(piece, self.manifest.pieces[piece].file)

    def onnx_path(self, piece: str) -> Path:
        """Where ``onnx_file`` is, for other programs; what is there by then was not checked."""
        return self.path / self.onnx_file(piece)

    def at_precision(self, name: str) -> Artifact:
        """The same artifact in a precision: its own, or ``fp32``, which all artifacts hold.

        Raises:
            ArtifactError: it has no weights of this precision.
        """
        if name not in (FP32, own := self.manifest.precision_name):
            known = list(dict.fromkeys((FP32, own)))
            raise ArtifactError(
                f"{self.path}: precision {name!r}: expected one that the artifact holds, {known}. Convert the"
                f" checkpoint again with --precision {name}."
            )
        if name == own:
            return self
        first = None if self.first_step is None else self.first_step.at_precision(name)
        return replace(self, manifest=replace(self.manifest, precision=None), first_step=first)

    def with_parts(self, parts: Collection[str]) -> Artifact:
        """The same artifact with only these parts (``ir.pieces.part_of``) in its precision."""
        record = self.manifest.precision
        models = {} if record is None else {n: file for n, file in record.models.items() if part_of(n) in parts}
        own = replace(record, models=models) if record is not None and models else None
        first = None if self.first_step is None else self.first_step.with_parts(parts)
        return replace(self, manifest=replace(self.manifest, precision=own), first_step=first)

    def with_reuse(self, reuse: ReuseRecord | None) -> Artifact:
        """The same artifact, reusing tokens in another way; None for not at all."""
        first = None if self.first_step is None else self.first_step.with_reuse(reuse)
        return replace(self, manifest=replace(self.manifest, reuse=reuse), first_step=first)

    def with_weights_of(self, plan: str | None) -> Artifact:
        """The artifact whose blocks are those that a plan computes after step 0: itself, but for ``distilled``.

        Step 0 has the original's weights in every plan.

        Args:
            plan: its name; None for one that has none.
        """
        record, manifest = self.manifest.distilled, self.manifest
        if plan != DISTILLED or record is None:
            return self
        pieces = {n: replace(one, file=record.models.get(n, one.file)) for n, one in manifest.pieces.items()}
        precision = manifest.precision
        if precision is not None:
            models = {name: record.precision_models.get(name, file) for name, file in precision.models.items()}
            precision = replace(precision, models=models)
        manifest = replace(manifest, pieces=pieces, precision=precision, distilled=None)
        return replace(self.with_weights(self.distilled), manifest=manifest, distilled={})

    @property
    def first_weights(self) -> Mapping[str, npt.NDArray[Any]]:
        """Constants that blocks have at step 0, where those are others."""
        return {} if self.first_step is None else {name: self.first_step.weights[name] for name in self.later}

    def with_weights(self, constants: Mapping[str, npt.NDArray[Any]]) -> Artifact:
        """The artifact with other constants after step 0, for the reference runtime, which reads no models.

        Args:
            constants: of residual blocks, by name.
        """
        return replace(self, weights={**self.weights, **constants}, first_step=self, later=tuple(constants))

    def schedule(self, name: str) -> PlanArray:
        """A schedule by name, ``dense`` among them, int8 ``[K, blocks]``.

        Raises:
            ArtifactError: there is none of this name.
        """
        if name == DENSE:
            return dense_plan(self.manifest.steps, len(self.manifest.blocks))
        if name not in self.schedules:
            known = [DENSE, *self.schedules]
            raise ArtifactError(f"{self.path}: has no schedule {name!r}; it has {known}. Use one of these.")
        return self.schedules[name]

    @cached_property
    def _document(self) -> Value:
        name = self.manifest.stores.program
        with self.reading(name):
            return parse(read_file(self.files / name, self.manifest.files[name].bytes), name)

    @cached_property
    def graphs(self) -> Mapping[str, Graph]:
        """Graphs of all pieces: ``condition``, ``step``, ``pruner``, ``stem``, ``block_00``..., ``tail``.

        Raises:
            ArtifactError: ``program.json`` is not valid, or asks for a constant that the artifact lacks.
        """
        graphs, stored = {}, {**self.pruner, **self.weights}
        for name, value in self._document.keys("graphs", "streams")["graphs"].members().items():
            graphs[name] = graph_from_json(value)
            constants = graphs[name].constants
            kinds = {n: (kind.dtype, kind.at(1)) for n, kind in constants.items()}
            tensors.check_arrays("constant", {n: stored[n] for n in constants if n in stored}, kinds, value.path)
        return MappingProxyType(graphs)

    def graph(self, name: str) -> Graph:
        """The graph of one piece.

        Raises:
            ArtifactError: ``program.json`` is not valid or has no such graph.
        """
        if name not in self.graphs:
            raise ArtifactError(f"{self.path}: has no graph {name!r}; it has {list(self.graphs)}. {REMEDY}")
        return self.graphs[name]

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces as the reference runtime executes them.

        Raises:
            ArtifactError: see ``graphs``.
        """
        streams = self._document.keys("graphs", "streams")["streams"].members()

        def inside(name: str) -> LoopPiece:
            graph = self.graph(name)
            if name not in streams:
                raise ArtifactError(f"{self.path}: has no stream of {name!r}; it has {list(streams)}. {REMEDY}")
            return LoopPiece(graph, streams[name].text(*graph.inputs))

        return Pieces(
            stem=inside(STEM),
            blocks=tuple(inside(block_name(b)) for b in range(len(self.manifest.blocks))),
            tail=inside(TAIL),
            condition=self.graph(CONDITION),
            step=self.graphs.get(STEP),
            pruner=self.graphs.get(PRUNER),
            tables=self.tables,
            bindings={name: context.binding for name, context in self.manifest.contexts.items()},
            features=self.manifest.features,
            frames=self.graphs.get(FRAMES),
            towers=tuple(self.graph(name) for name in frame_pieces(self.graphs)),
        )


def load_artifact(path: str | Path) -> Artifact:
    """Open an artifact and check all of it: schema, sizes and hashes of all files, identity, plans, onnxruntime.

    Args:
        path: the directory that ``convert`` wrote, or the same zipped.

    Returns:
        The artifact; arrays are mapped, not read.

    Raises:
        ArtifactChangedError: it was replaced or changed meanwhile.
        ArtifactError: says what is wrong, where, and what to do.
    """
    place = Path(path)
    require_artifact_path(place)
    if place.is_dir():
        return _load_directory(place, place)
    _refuse_checkpoint(place)
    unpacked = unpack(place)
    try:
        return replace(_load_directory(unpacked.path, place), _unpacked=unpacked)
    except BaseException:
        unpacked.remove()
        raise


def require_artifact_path(path: Path) -> None:
    """Raise unless there is something that may be an artifact.

    Raises:
        ArtifactError: there is nothing, or something that is never read.
    """
    require_path(path, ArtifactError, "Give the directory that 'ttscompile convert' wrote.")


def read_manifest(directory: Path) -> Manifest:
    """Read ``manifest.json`` of a directory, and nothing else.

    Raises:
        ArtifactError: not an artifact, or a manifest that is damaged or of another schema version.
    """
    path = directory / MANIFEST
    require_artifact_path(directory)
    if not os.path.lexists(path):
        _refuse_checkpoint(directory)
        raise ArtifactError(
            f"{directory}: not an artifact: it has no {MANIFEST}. Give the directory that 'ttscompile convert' wrote."
        )
    return decode(read_file(path, MAX_MANIFEST_BYTES), str(path))


def _refuse_checkpoint(path: Path) -> None:
    if is_checkpoint(path):
        raise ArtifactError(
            f"{path}: a checkpoint, not an artifact. Convert it first: ttscompile convert {path} -o DIR."
        )


def _load_directory(path: Path, shown: Path) -> Artifact:
    try:
        folder = Folder(path, shown)
    except OSError as error:
        raise ArtifactError(f"{shown}: cannot be opened: {error}. {REMEDY}") from error
    with folder.unchanged([MANIFEST]) as first:
        manifest = read_manifest(folder.files)
        check_runtime(manifest.requires, folder.files)
        with folder.unchanged(manifest.files) as stamps:
            for name, record in manifest.files.items():
                check_file(folder.files / name, record)
            return _open(path, folder, {**first, **stamps}, manifest)


def _open(path: Path, folder: Folder, stamps: Mapping[str, Stamp], manifest: Manifest) -> Artifact:
    directory = folder.files
    if identities(manifest) != (manifest.identity, manifest.model_identity):
        raise ArtifactError(
            f"{directory}: expected the identity {manifest.short_identity}; its content has"
            f" {abbreviated(identities(manifest)[0])}. {REMEDY}"
        )
    check_size(manifest, directory)
    for name in sorted(manifest.models):
        check_model(directory / name, manifest.files)
    stored = tensors.read(directory / manifest.stores.weights)
    tables = {n.removeprefix(TABLE_PREFIX): a for n, a in stored.items() if n.startswith(TABLE_PREFIX)}
    kinds = {n: c.type for n, c in manifest.contexts.items() if c.binding is Binding.TABLE}
    wanted = {name: (kind.dtype, (manifest.steps, *kind.at(1))) for name, kind in kinds.items()}
    tensors.check_arrays("table", tables, wanted, directory / manifest.stores.weights)
    schedules, corrections = _plans(directory, manifest)
    distilled = _optional(directory, None if manifest.distilled is None else manifest.distilled.weights)
    of_weights = {name: (str(stored[name].dtype), stored[name].shape) for name in distilled if name in stored}
    tensors.check_arrays("distilled weight", distilled, of_weights, directory)
    return Artifact(
        path=path,
        manifest=manifest,
        weights=MappingProxyType({n: a for n, a in stored.items() if not n.startswith(TABLE_PREFIX)}),
        tables=MappingProxyType(tables),
        pruner=_optional(directory, manifest.stores.pruner),
        schedules=schedules,
        corrections=corrections,
        distilled=distilled,
        _folder=folder,
        _stamps=stamps,
    )


def _optional(directory: Path, name: str | None) -> Mapping[str, npt.NDArray[Any]]:
    return MappingProxyType({}) if name is None else tensors.read(directory / name)


def _plans(directory: Path, manifest: Manifest) -> tuple[Mapping[str, PlanArray], Mapping[str, Correction]]:
    """Schedules, and the corrections that belong to plans."""
    stored = _optional(directory, manifest.stores.plans)
    where = directory / (manifest.stores.plans or MANIFEST)
    schedules = {name: array for name, array in stored.items() if not name.startswith(PREFIX)}
    expected = sorted(name for name, plan in manifest.plans.items() if not plan.pruned)
    if expected != sorted(schedules):
        raise ArtifactError(f"{where}: expected schedules {expected}; found {sorted(schedules)}. {REMEDY}")
    for name, plan in schedules.items():
        try:
            check_schedule(name, plan, manifest)
        except IllegalPlanError as error:
            raise ArtifactError(f"{where}: {name}: {error} {REMEDY}") from error
    corrections = read_corrections(stored, manifest, str(where))
    return MappingProxyType(schedules), MappingProxyType(corrections)


def check_schedule(name: str, plan: npt.NDArray[Any], manifest: Manifest) -> None:
    """Raise unless this is a schedule of the policy: int8 ``[K, blocks]`` with a dense step 0.

    Raises:
        IllegalPlanError: it is not.
    """
    steps, blocks = manifest.steps, len(manifest.blocks)
    if plan.dtype != np.int8 or plan.ndim != 2:
        raise IllegalPlanError(
            f"schedule {name!r}: expected int8[{steps}, {blocks}]; found {plan.dtype}{list(plan.shape)}."
        )
    try:
        check_plan(plan, steps, blocks, 1)
    except IllegalPlanError as error:
        raise IllegalPlanError(f"schedule {name!r}: {error}") from error
    if (plan[0] != Source.COMPUTE).any():
        raise IllegalPlanError(f"schedule {name!r}: expected COMPUTE in all of step 0; found {plan[0].tolist()}.")
