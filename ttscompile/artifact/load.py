"""Open an artifact: everything is checked before anything of it is used. Needs numpy alone."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ..core.coercion import Arrays, Errors
from ..core.envelope import Envelope
from ..core.lattice import check_schedule, dense_plan
from ..core.paths import require_path
from ..core.plan import DENSE, ORIGINAL, Plan
from ..core.spec import BF16, FP16, FP32, INT4, INT8
from ..core.tokenizer import ReadTokenizer, Tokenizer
from ..errors import ArtifactError, IllegalPlanError
from ..ir import pieces as names
from ..ir.graph import Graph
from ..ir.program import Binding, Pieces
from . import tensors
from .archive import Unpacked, is_checkpoint, unpack
from .codec import MAX_MANIFEST_BYTES, decode, identities
from .corrections import ENVELOPE, PREFIX, read_corrections, read_envelope
from .files import Folder, Stamp, check_file, read_file
from .graph_json import graph_from_json
from .manifest import MANIFEST, Manifest, abbreviated
from .onnx_files import check_models
from .requires import check_runtime, check_size
from .strict_json import REMEDY, Value, parse

TABLE_PREFIX = "table/"
PRECISIONS = (FP32, INT8, INT4, BF16, FP16)
LOOP_PREFIX = "loop/"
"""Of the tables of loops beside the original's: ``loop/NAME/CONTEXT``."""


@dataclass(frozen=True, eq=False)
class Artifact:
    """An artifact on disk, checked.

    Attributes:
        path: the directory; of a zipped artifact a temporary one, which lives as long as this object.
        manifest: what is not array or graph.
        weights: constants of all pieces but the pruner's, read-only; views of a large file.
        loop_tables: by loop that begins with noise, its TABLE contexts ``[K, ...]``, which are read and never mapped.
        pruners: by loop that has a pruner of its own, the constants of that (their names start with ``pruner.``). All
            other loops have the original's, which has no constants if there is no pruner.
        plans: by name, ``dense`` the first of them.
        block_weights: by the name of weights that plans may have, the constants that blocks have in place of those of
            ``weights``; read-only, views of large files.
        envelope: of what its corrections were fitted on; None where that is not known.
    """

    path: Path
    manifest: Manifest
    weights: Arrays
    loop_tables: Mapping[str, Arrays]
    pruners: Mapping[str, Arrays]
    plans: Mapping[str, Plan]
    block_weights: Mapping[str, Arrays]
    envelope: Envelope | None
    _folder: Folder = field(repr=False)
    _stamps: Mapping[str, Stamp] = field(repr=False)
    _unpacked: Unpacked | None = field(default=None, repr=False)
    _derived: dict[str, Plan] = field(default_factory=dict, repr=False)

    @property
    def tables(self) -> Arrays:
        """TABLE contexts of the original loop."""
        return self.loop_tables[ORIGINAL]

    @property
    def pruner(self) -> Arrays:
        """Constants of the original loop's pruner."""
        return self.pruners[ORIGINAL]

    @property
    def without(self) -> str | None:
        """Name of the file of what is read in fp32 alone, where this copy lacks it; None for a whole artifact."""
        return None if self.manifest.apart in self._stamps else self.manifest.apart

    @property
    def bytes(self) -> int:
        """Of all files that are there, but the manifest."""
        return sum(self.manifest.files[name].bytes for name in self.present)

    @property
    def present(self) -> list[str]:
        """Names of all files that are there, but the manifest."""
        return [name for name in self.manifest.files if name in self._stamps]

    def require_whole(self) -> None:
        """Raise ArtifactError if this copy lacks what is read in fp32 alone."""
        if self.without is not None:
            held = f"it has plans in {self.manifest.precision_name} alone: 'NAME@{self.manifest.precision_name}'"
            raise ArtifactError(
                f"{self.path}: expected {self.without}, for what is asked is in fp32; this copy lacks it, and {held}."
                " Take one of these, or copy that file too."
            )

    @property
    def tokenizer(self) -> ReadTokenizer | None:
        """Reads what makes an instruction's text the policy's tokens; None where the artifact has no such file."""
        return None if self.manifest.stores.tokenizer is None else self._read_tokenizer

    def _read_tokenizer(self, error: Errors) -> Tokenizer:
        name = self.manifest.stores.tokenizer
        assert name is not None
        with self.reading(name):
            return Tokenizer(self.files / name, error)

    @property
    def files(self) -> Path:
        """The folder to read from, within ``reading``: still the one that was checked when another is at ``path``."""
        return self._folder.files

    @contextmanager
    def reading(self, *given: str) -> Iterator[None]:
        """Within the block these files, in ``files``, are those that were checked. Else ArtifactChangedError."""
        wanted = given or self.present
        with self._folder.unchanged(wanted) as now:
            for name in wanted:
                if now[name] == self._stamps.get(name):
                    continue
                try:
                    check_file(self.files / name, self.manifest.files[name])
                except (ArtifactError, KeyError) as error:  # the manifest itself has no record
                    raise self._folder.changed([name]) from error
            yield

    @property
    def default(self) -> Plan:
        """The plan that is taken when none is given."""
        return self.plans[self.manifest.default_plan]

    def plan(self, name: str) -> Plan:
        """A plan by its name, or in another precision: ``NAME@fp32``, ``NAME@int8``, ``NAME@bf16``.

        In each of these all tokens are computed, too, which every runtime can do. int8 is of all parts that the
        artifact has such models of. bf16 and fp16, which torch makes of the weights, are of all parts. Parts may be
        named in place of these: ``NAME@int8+PART+PART``. What it falls back on (``Plan.otherwise``) is in the same.

        Raises:
            IllegalPlanError: there is none of this name.
        """
        if not isinstance(name, str):
            found = f"found a {type(name).__name__}. A matrix is for predict_action(plan=...), call by call"
            raise IllegalPlanError(f"expected a ttscompile.Plan, or the name of one, {list(self.plans)}; {found}.")
        own, at, rest = name.partition("@")
        precision, *parts = rest.split("+")
        known = own in self.plans and (not at or precision in PRECISIONS) and all(parts)
        if not known or (parts and precision == FP32):
            remedy = "Use one of these, NAME@PRECISION or NAME@int8+PART for another precision, or dataclasses.replace"
            raise IllegalPlanError(f"the artifact has no plan {name!r}; it has {list(self.plans)}. {remedy}.")
        if not precision:
            return self.plans[own]
        if name not in self._derived:
            plan, held = self.plans[own].exact, names.parts_of(self.manifest.pieces)
            if precision in (INT8, INT4):  # without any, what is missing is told when it is opened
                held = tuple(self.manifest.held) or (names.BLOCKS,)
            plan = plan if precision == FP32 else replace(plan, precision=dict.fromkeys(parts or held, precision))
            first = self.plans[own].otherwise
            otherwise = None if first is None else self.plan(f"{self.name_of(first)}@{rest}")
            self._derived[name] = replace(plan, otherwise=otherwise)  # another object than the one in fp32 may be
        return self._derived[name]

    def name_of(self, plan: Plan) -> str | None:
        """The name of a plan of the artifact; None for any other."""
        return next((name for name, one in self.plans.items() if one is plan), None)

    def told(self, plan: Plan) -> str | None:
        """The name by which ``plan`` gives it, ``NAME@int8`` too; None for a plan that is not this artifact's."""
        return self.name_of(plan) or next((name for name, one in self._derived.items() if one is plan), None)

    @cached_property
    def _document(self) -> Value:
        name = self.manifest.stores.program
        with self.reading(name):
            return parse(read_file(self.files / name, self.manifest.files[name].bytes), name)

    @cached_property
    def graphs(self) -> Mapping[str, Graph]:
        """Graphs of all pieces: ``condition``, ``step``, ``pruner``, ``stem``, ``block_00``..., ``tail``."""
        graphs, own = {}, {names.of_loop(names.PRUNER, loop): one for loop, one in self.pruners.items()}
        for name, value in self._document.keys("graphs", "streams")["graphs"].members().items():
            graphs[name] = graph_from_json(value)
            constants, stored = graphs[name].constants, own.get(name, {**self.pruner, **self.weights})
            constants = {n: kind for n, kind in constants.items() if n in stored or self.without is None}
            kinds = {n: (kind.dtype, kind.at(1)) for n, kind in constants.items()}
            tensors.check_arrays("constant", {n: stored[n] for n in constants if n in stored}, kinds, value.path)
        return MappingProxyType(graphs)

    def graph(self, name: str) -> Graph:
        """The graph of one piece. Raises ArtifactError: ``program.json`` is not valid or has no such graph."""
        if name not in self.graphs:
            raise ArtifactError(f"{self.path}: has no graph {name!r}; it has {list(self.graphs)}. {REMEDY}")
        return self.graphs[name]

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces as the reference runtime executes them. Raises ArtifactError: see ``graphs``."""
        streams = self._document.keys("graphs", "streams")["streams"].members()

        def inside(name: str) -> names.LoopPiece:
            graph = self.graph(name)
            if name not in streams:
                raise ArtifactError(f"{self.path}: has no stream of {name!r}; it has {list(streams)}. {REMEDY}")
            return names.LoopPiece(graph, streams[name].text(*graph.inputs))

        return Pieces(
            stem=inside(names.STEM),
            blocks=tuple(inside(names.block_name(b)) for b in range(len(self.manifest.blocks))),
            tail=inside(names.TAIL),
            condition=self.graph(names.CONDITION),
            step=self.graphs.get(names.STEP),
            pruner=self.graphs.get(names.PRUNER),
            tables=self.tables,
            bindings={name: context.binding for name, context in self.manifest.contexts.items()},
            features=self.manifest.features,
            frames=self.graphs.get(names.FRAMES),
            towers=tuple(self.graph(name) for name in names.frame_pieces(self.graphs)),
            scene=self.graphs.get(names.SCENE),
        )


def load_artifact(path: str | Path) -> Artifact:
    """Open an artifact and check all of it: schema, sizes and hashes of all files, identity, plans, onnxruntime.

    Arrays are mapped, not read. One that was replaced or changed meanwhile is an ``ArtifactChangedError``.
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
    """Raise unless there is something that may be an artifact."""
    require_path(path, ArtifactError, "Give the directory that 'ttscompile build' wrote.")


def read_manifest(directory: Path) -> Manifest:
    """Read ``manifest.json`` of a directory, and nothing else."""
    path = directory / MANIFEST
    require_artifact_path(directory)
    if not os.path.lexists(path):
        _refuse_checkpoint(directory)
        raise ArtifactError(
            f"{directory}: not an artifact: it has no {MANIFEST}. Give the directory that 'ttscompile build' wrote."
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
        with folder.unchanged(present(manifest, folder.files)) as stamps:
            for name in stamps:
                check_file(folder.files / name, manifest.files[name])
            return _open(path, folder, {**first, **stamps}, manifest)


def present(manifest: Manifest, directory: Path) -> list[str]:
    """The files that have to be there: all but what is read in fp32 alone, where it is not."""
    return [name for name in manifest.files if name != manifest.apart or os.path.lexists(directory / name)]


def _open(path: Path, folder: Folder, stamps: Mapping[str, Stamp], manifest: Manifest) -> Artifact:
    directory = folder.files
    if identities(manifest) != (manifest.identity, manifest.model_identity):
        raise ArtifactError(
            f"{directory}: expected the identity {manifest.short_identity}; its content has"
            f" {abbreviated(identities(manifest)[0])}. {REMEDY}"
        )
    check_size(manifest, directory)
    check_models(directory, manifest.models, manifest.acting)
    stores = manifest.stores
    others = sorted(stamps.keys() - manifest.models - {stores.program, stores.tokenizer, MANIFEST})
    tensors.require_few((directory / name for name in others), directory)
    stored = tensors.read(directory / manifest.stores.weights, short=True)
    if manifest.apart in stamps:
        stored = MappingProxyType({**stored, **tensors.read(directory / str(manifest.apart), short=True)})
    tables = {loop: _tables(stored, manifest, loop, directory) for loop in (ORIGINAL, *manifest.spec.loops)}
    block_weights = {}
    for name, record in manifest.weights.items():
        block_weights[name] = own = tensors.read(directory / record.weights)
        of_weights = {n: (str(stored[n].dtype), stored[n].shape) for n in own if n in stored}
        known = own if manifest.apart in (None, *stamps) else {n: own[n] for n in of_weights}
        tensors.check_arrays(f"{name} weight", known, of_weights, directory)
    return Artifact(
        path=path,
        manifest=manifest,
        weights=MappingProxyType({n: a for n, a in stored.items() if not n.startswith((TABLE_PREFIX, LOOP_PREFIX))}),
        loop_tables=MappingProxyType(tables),
        pruners={loop: _optional(directory, file) for loop, file in manifest.pruner_files.items()},
        plans=_plans(directory, manifest),
        block_weights=MappingProxyType(block_weights),
        envelope=read_envelope(_optional(directory, manifest.stores.plans), manifest, str(directory)),
        _folder=folder,
        _stamps=stamps,
    )


def _optional(directory: Path, name: str | None) -> Arrays:
    return MappingProxyType({}) if name is None else tensors.read(directory / name)


def table_prefix(loop: str) -> str:
    """Before the name of a context it is the name of the array of its rows in a loop."""
    return TABLE_PREFIX if loop == ORIGINAL else f"{LOOP_PREFIX}{loop}/"


def _tables(stored: Arrays, manifest: Manifest, loop: str, where: Path) -> Arrays:
    prefix, steps = table_prefix(loop), manifest.sampler_of(loop).steps
    tables = {n.removeprefix(prefix): np.array(array) for n, array in stored.items() if n.startswith(prefix)}
    kinds = {n: c.type for n, c in manifest.contexts.items() if c.binding is Binding.TABLE}
    wanted = {name: (kind.dtype, (steps, *kind.at(1))) for name, kind in kinds.items()}
    tensors.check_arrays("table", tables, wanted, where / manifest.stores.weights)
    return MappingProxyType(tables)


def _plans(directory: Path, manifest: Manifest) -> Mapping[str, Plan]:
    stored, blocks = _optional(directory, manifest.stores.plans), len(manifest.blocks)
    where = directory / (manifest.stores.plans or MANIFEST)
    schedules = {name: array for name, array in stored.items() if not name.startswith((PREFIX, ENVELOPE))}
    expected = sorted(name for name, plan in manifest.plans.items() if plan.kind == "schedule")
    if expected != sorted(schedules):
        raise ArtifactError(f"{where}: expected schedules {expected}; found {sorted(schedules)}. {REMEDY}")
    for name, cells in schedules.items():
        try:
            check_schedule(name, cells, manifest.steps_of(manifest.plans[name].loop), blocks)
        except IllegalPlanError as error:
            raise ArtifactError(f"{where}: {name}: {error} {REMEDY}") from error
    corrections = read_corrections(stored, manifest, str(where))
    plans = {DENSE: Plan(cells=dense_plan(manifest.steps, blocks), repair=True)}
    # A plan may name another one that does not begin with a chunk: those come first.
    for name, record in sorted(manifest.plans.items(), key=lambda item: item[1].otherwise is not None):
        computed = record.kind == "all"
        plans[name] = Plan(
            loop=record.loop,
            cells=dense_plan(manifest.steps_of(record.loop), blocks) if computed else schedules.get(name),
            correction=corrections.get(name),
            weights=record.weights,
            precision=record.precision,
            tokens=record.tokens,
            otherwise=None if record.otherwise is None else plans[record.otherwise],
            repair=True,
        )
    for cells in (plan.cells for plan in plans.values() if plan.cells is not None):
        cells.setflags(write=False)  # by its name everybody gets this plan
    return MappingProxyType({name: plans[name] for name in (DENSE, *manifest.plans)})
