"""An artifact as the plans of one variant see it: one loop, one set of weights, one precision a part.

A backend computes on a view. It has what an artifact with this loop alone would have, under the same names; arrays and
files are the artifact's own.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

from ..core.coercion import Arrays
from ..core.correction import condition_flops, groups_of
from ..core.lattice import PlanArray
from ..core.plan import ORIGINAL, Plan, Variant
from ..core.start import Start, rest_of
from ..core.update import update_flops
from ..errors import ArtifactError, IllegalPlanError
from ..ir.flops import graph_flops
from ..ir.pieces import ADVANCE, PRUNER, SCENE, STEP, frame_pieces, of_loop, part_of
from ..ir.program import Pieces
from .load import Artifact
from .manifest import Manifest, WeightsRecord


@dataclass(frozen=True, eq=False)
class View:
    """See the module. ``view_of`` makes it.

    Attributes:
        manifest: the artifact's, with the sampler, FLOPs and pieces of this loop, and the plans of this variant.
        tables: TABLE contexts ``[K, ...]`` of this loop.
        start: how a loop begins that goes on with the chunk of the call before; None where it begins with noise.
        plans: by name, the artifact's plans of this variant, but for ``dense``.
    """

    artifact: Artifact
    variant: Variant
    manifest: Manifest
    tables: Arrays
    start: Start | None
    plans: Mapping[str, Plan]

    @property
    def pruner(self) -> Arrays:
        """Constants of this loop's pruner."""
        return self.artifact.pruners.get(self.variant.loop, self.artifact.pruner)

    @property
    def groups(self) -> int:
        """Into how many groups of action dimensions the models of this loop take the sampler's update."""
        whole = self.manifest.steps + (0 if self.start is None else self.start.skipped)
        return groups_of(whole, self.manifest.spec.sample)

    @property
    def precision(self) -> Mapping[str, str]:
        """By part, where it is not fp32."""
        return dict(self.variant.precision)

    @property
    def schedules(self) -> Mapping[str, PlanArray]:
        """Cells of its plans, without those that the pruner makes, int8 ``[K, blocks]`` by name."""
        return {name: plan.cells for name, plan in self.plans.items() if plan.cells is not None}

    @property
    def pruned(self) -> bool:
        """Whether some of its plans is made by the pruner."""
        return any(plan.pruned for plan in self.plans.values())

    @property
    def weights(self) -> Arrays:
        """Constants of all pieces but the pruner's, as blocks have them from step 1 on; see ``require_whole``."""
        self.artifact.require_whole()
        return {**self.artifact.weights, **self._trained} if self._trained else self.artifact.weights

    @property
    def first_weights(self) -> Arrays:
        """Constants that blocks have at step 0, where those are others: step 0 has the original's in every plan."""
        return {name: self.artifact.weights[name] for name in self._trained}

    @property
    def _trained(self) -> Arrays:
        return {} if self.variant.weights == ORIGINAL else self.artifact.block_weights[self.variant.weights]

    def onnx_file(self, piece: str, first_step: bool = False) -> str:
        """Name of the ONNX file of a piece, in its precision and with its weights; at step 0 with the original's."""
        manifest = self.artifact.manifest
        own: WeightsRecord | None = None
        if self.variant.weights != ORIGINAL and not first_step:
            own = manifest.weights[self.variant.weights]
        lower = manifest.precision
        if lower is not None and self.precision.get(str(part_of(piece))) == lower.name and piece in lower.models:
            return lower.models[piece] if own is None else own.precision_models.get(piece, lower.models[piece])
        file = self.manifest.pieces[piece].file
        return file if own is None else own.models.get(piece, file)

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces as the reference runtime executes them; see ``Artifact``."""
        own, graphs = self.artifact.pieces, self.artifact.graphs
        return replace(own, tables=self.tables, pruner=graphs.get(of_loop(PRUNER, self.variant.loop), own.pruner))

    @property
    def frames_key(self) -> object:
        """Equal for views that compute the same of a frame or a scene, and so can share what they remember."""
        pieces = (*frame_pieces(self.manifest.pieces), *{SCENE} & set(self.manifest.pieces))
        return self.variant.tokens, tuple(map(self.onnx_file, pieces))


def view_of(artifact: Artifact, plan: Plan | str | None = None) -> View:
    """The view for a plan.

    Args:
        plan: a plan, or the name of one; None for the artifact's default.

    Raises:
        IllegalPlanError: the artifact has no such plan, loop, weights, or tokens to reuse.
        SpecError: the plan's loop does not tell what it begins with (``core.start``).
    """
    if not isinstance(plan, Plan):
        plan = artifact.default if plan is None else artifact.plan(plan)
    manifest, variant = artifact.manifest, plan.variant
    _require(manifest, variant)
    start, base, record = None, manifest.whole_loop(variant.loop), manifest.starts.get(variant.loop)
    sampler, tables = manifest.sampler_of(base), artifact.loop_tables[base]
    if record is not None:
        sampler, start = rest_of(sampler, record.steps)
        tables = MappingProxyType({name: rows[start.skipped :] for name, rows in tables.items()})
    spec, pieces = replace(manifest.spec, sampler=sampler, loops={}), dict(manifest.pieces)
    for piece in (ADVANCE, PRUNER):
        if (own := of_loop(piece, base)) in pieces:
            pieces[piece] = pieces[own]
    if start is not None:  # a pruner decides about whole loops
        pieces.pop(PRUNER, None)
    flops, sample, more = manifest.flops, spec.sample, sampler.steps - manifest.steps
    if more:
        values = graph_flops(artifact.graph(STEP)) * more if STEP in pieces else 0
        read = [condition_flops(k, sample, manifest.condition_numbers) for k in (sampler.steps, manifest.steps)]
        flops = replace(flops, prologue=flops.prologue + values + read[0] - read[1])
    update = update_flops(sampler, sample) - update_flops(manifest.spec.sampler, sample)
    flops = replace(flops, tail=flops.tail + update)
    plans = {name: artifact.plans[name] for name in manifest.plans if artifact.plans[name].variant == variant}
    records = {name: manifest.plans[name] for name in plans}
    seen = replace(manifest, spec=spec, pieces=pieces, flops=flops, plans=records)
    return View(artifact, variant, seen, tables, start, MappingProxyType(plans))


def _require(manifest: Manifest, variant: Variant) -> None:
    """Raise IllegalPlanError unless the artifact has what a plan names; what a runtime can do is another question."""
    if variant.loop not in manifest.loops:
        raise IllegalPlanError(f"the artifact has no loop {variant.loop!r}; it has {list(manifest.loops)}.")
    if variant.weights not in (known := [ORIGINAL, *manifest.weights]):
        raise IllegalPlanError(f"the artifact has no weights {variant.weights!r}; it has {known}.")
    if variant.tokens is not None and not manifest.tokens:
        remedy = "Leave tokens out of the plan: dataclasses.replace(plan, tokens=None)."
        raise IllegalPlanError(f"no image encoder of this policy has tokens that could be reused. {remedy}")
    if variant.tokens is not None and variant.tokens.scene is not None and SCENE not in manifest.tokens:
        remedy = "Leave the scene out: TokenReuse(threshold, refresh)."
        raise IllegalPlanError(f"the scene of this policy, if it has one, has no tokens that could be reused. {remedy}")
    if variant.tokens is not None and variant.tokens.scene is None and list(manifest.tokens) == [SCENE]:
        remedy = "Say when they are computed: TokenReuse(threshold, refresh, scene=0.2)."
        raise IllegalPlanError(f"only the scene of this policy has tokens that could be reused. {remedy}")


def require_held(artifact: Artifact, plan: Plan) -> None:
    """Raise ArtifactError unless the artifact holds models for every precision of a plan."""
    held = artifact.manifest.held
    if not held.items() <= plan.precision.items():
        artifact.require_whole()
    for part, precision in plan.precision.items():
        if held.get(part) != precision:
            known = ", ".join(f"{name} in {one}" for name, one in held.items()) or "fp32 alone"
            remedy = f"Convert the checkpoint again with --precision {precision}, or take a plan without it"
            raise ArtifactError(
                f"{artifact.path}: a plan wants {part!r} in {precision!r}; the artifact has {known}. {remedy}."
            )
