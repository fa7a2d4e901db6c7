"""What an artifact says of itself, as sections of a report."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from ..artifact.ceiling import BOUND, FARTHEST, few_steps, uncalibrated
from ..artifact.load import Artifact
from ..artifact.manifest import BlockRecord, Manifest, PlanRecord, marked
from ..artifact.view import view_of
from ..core.envelope import FAR
from ..core.lattice import dense_plan
from ..core.plan import DENSE, SCHEDULE
from ..core.poses import NUMBERS
from ..core.spec import ObservationSpec, SamplerTable
from ..ir.flops import frames_flops, graph_flops, once_flops
from ..ir.pieces import SCENE
from ..ir.program import Binding
from ..measure.machine import elsewhere
from ..measure.timer import MANY
from ..measure.units import flops, ms, plain, rounded_up, share
from ..runtimes.liveness import rollout_needs
from .page import Section, Table

_NOT_TOLD = "plans precision sparsity flops_sparsity skipped other_noise told frontier timed_on".split()


def provenance(artifact: Artifact) -> Section:
    """Identity, and where it comes from."""
    manifest = artifact.manifest
    source = ", ".join(f"{key}: {value}" for key, value in manifest.spec.source.items())
    rows = (
        ("identity", manifest.identity),
        ("identity of the model, without plans", manifest.model_identity),
        ("made from", source or "a module of the user's own (compile_denoiser)"),
        ("made by", f"ttscompile {manifest.ttscompile_version}, artifact schema {manifest.schema_version}"),
        ("needs", f"onnxruntime {manifest.requires.onnxruntime} or later (opset {manifest.requires.opset}), numpy"),
        ("files", f"{len(artifact.present) + 1}, {artifact.bytes / 1e6:.1f} MB; sizes and hashes of all were checked"),
    )
    text = "The identity is a hash over weights, normaliser, sampler, plans and preprocessing: whatever prints the same"
    return Section("Identity", (f"{text} one computes the same.",), (Table(("", ""), rows, prose=True),))


def policy(artifact: Artifact) -> Section:
    """What goes in, what comes out, the loops between, and what is kept for them."""
    manifest, envelope = artifact.manifest, artifact.envelope
    spec, needs = manifest.spec, rollout_needs(view_of(artifact))
    (horizon, channels), chunk = spec.sample, spec.chunk
    action = f"{chunk.action_dim} numbers, {horizon} steps predicted, {chunk.start}..{chunk.stop - 1} executed"
    action += f"; {spec.left_out} more are left out" * bool(spec.left_out)
    action += f"; the sample has {channels} channels" * (channels != chunk.action_dim)
    if (relative := chunk.relative) is not None:
        action += f"; {sum(n is not None for n in relative.columns)} of the numbers are relative to {relative.key!r}"
        action += f", {NUMBERS * len(relative.poses)} of them in poses" * bool(relative.poses)
    kept = (
        f"{needs.read} of {needs.cells} residuals a stream, {needs.bytes_read / 1e6:.1f} MB, for its plans;"
        f" {needs.bytes_most / 1e6:.1f} MB for plans that you give"
    )
    before = ", from the chunk of the call before"
    rows = [
        *((f"observation {key!r}", _observation(one)) for key, one in spec.observations.items()),
        *([] if spec.instruction is None else [("instruction", told_in_words(manifest))]),
        ("action", action),
        *((f"loop {name!r}", told_sampler(table)) for name, table in spec.all_loops.items()),
        *((f"loop {n!r}", f"the last {one.steps} steps of {one.loop!r}{before}") for n, one in manifest.starts.items()),
        ("precision", precision(manifest)),
        *tokens(manifest),
        ("rollout cache", kept),
    ]
    if envelope is not None:
        far = f"beyond {FAR:g} times the furthest call there is no correction"
        rows.append(("envelope", f"{len(envelope.center)} components of what was recorded; {far}"))
    rows.append(("default plan", manifest.default_plan))
    return Section("Policy", (), (Table(("", ""), tuple(rows), prose=True),))


def _observation(one: ObservationSpec) -> str:
    inside = "as it is" if one.normalizer is None else "normalised inside"
    return f"{one.dtype}{list(one.shape)} a stream, {inside}" + ", from pictures of any size" * (one.fit is not None)


def told_in_words(manifest: Manifest) -> str:
    """Whether a policy that reads an instruction takes it as text."""
    if manifest.stores.tokenizer is None:
        return "its tokens, or the text 'task' where the policy is loaded with tokenizer=DIR"
    return f"the text 'task' in place of its tokens, which {manifest.stores.tokenizer} makes"


def told_sampler(table: SamplerTable) -> str:
    """What a loop is, in words."""
    clip = "no clip of the denoised sample" if table.clip is None else f"the denoised sample clipped at {table.clip:g}"
    noise = "draws noise in its steps" if table.stochastic else "draws no noise"
    steps = f"{table.steps} steps, timesteps {table.timesteps[0]:g}..{table.timesteps[-1]:g}"
    return f"{table.name}, {steps}, {noise}, {clip}"


def tokens(manifest: Manifest) -> list[tuple[str, str]]:
    """Of each image encoder, and the scene, that has tokens, which plans reuse them."""
    plans = [(name, plan.tokens) for name, plan in manifest.plans.items() if plan.tokens is not None]
    found = []
    for piece, record in manifest.tokens.items():
        of, what = ("scene", "row") if piece == SCENE else ("frame", "patch")
        reusing = [
            f"{name} computes a token anew where its {what} differs by more than"
            f" {one.threshold if of == 'frame' else one.scene:g}, and one {of} of {one.refresh} whole"
            for name, one in plans
            if of == "frame" or one.scene is not None
        ]
        told = "; ".join(reusing) or "every plan computes all of them"
        found.append((f"tokens of {piece}", f"{record.tokens} a {of}; {told}"))
    return found


def precision(manifest: Manifest) -> str:
    """What computes in which precision: ``fp32``, or ``int8 in blocks and condition; fp32 in step``."""
    record = manifest.precision
    if record is None:
        return manifest.precision_name
    return record.told + f"; fp32 in {' and '.join(record.asked)}" * bool(record.asked)


def hoisting(artifact: Artifact) -> Section:
    """What is computed when, and what that saves before anything is reused."""
    manifest = artifact.manifest
    record, steps = manifest.flops, manifest.steps
    bound = Counter(context.binding for context in manifest.contexts.values())
    table_bytes = sum(table.nbytes for table in artifact.tables.values())
    pieces, frames = artifact.pieces, frames_flops(artifact.pieces)
    condition = graph_flops(pieces.condition)
    scene = once_flops(pieces) - frames - condition
    late = [key for key, one in manifest.spec.observations.items() if one.numbers]
    told = 0 < len(late) < len(manifest.spec.observations)  # else nothing could stand still, or nothing moves
    loop = steps * (record.stem + record.tail + sum(record.blocks))
    dense = record.prologue + loop

    def row(name: str, when: str, values: str, cost: float) -> tuple[str, ...]:
        return name, when, values, flops(cost), share(cost / record.dense)

    tables = f"{len(artifact.tables)} tables of {steps} rows, {table_bytes / 1e6:.1f} MB"
    count, batched = sum(pieces.rows), max(record.prologue - once_flops(pieces), 0)
    when = "once a call" + f", since it reads {' and '.join(late)}" * told
    rows = (
        row("table", "when it was compiled", tables, 0),
        *([row("frame", "once a frame, or instruction", f"of {count} frames a call", frames)] if count else []),
        *([row("scene", "once, until a picture or a word changes", "", scene)] if scene else []),
        row("condition", when, f"{bound[Binding.CONDITION]} values", condition),
        row("step", f"once a call, {steps} steps in one batch", f"{bound[Binding.STEP]} values", batched),
        row("loop", f"{steps} times a call", f"stem, {len(record.blocks)} blocks, tail", loop),
        row("all, every cell computed", "", "", dense),
        row("the denoiser as it was captured", f"{steps} times a call", "", record.dense),
    )
    saved = record.dense - dense
    text = (
        f"Work that does not depend on the noisy sample has left the loop: {flops(abs(saved))} a call"
        f" ({share(abs(saved) / record.dense)}) {'less' if saved >= 0 else 'more'} before anything is reused."
        f" Multiply and add are counted as two; a pruner, where a plan uses one, adds {flops(record.pruner)}."
    )
    head = ("binding time", "computed", "values that the loop reads", "FLOPs a call", "of the captured denoiser")
    return Section("Hoisting", (text,), (Table(head, rows),))


def blocks(manifest: Manifest) -> Section:
    """The block table, and what a group is."""
    text = f"{len(manifest.blocks)} residual blocks, numbered in order of execution."
    forward = "Reuse from the last block of a kind (FORWARD) stays within a group."
    return Section("Blocks", (f"{text} {forward}",), (block_table(manifest),))


def block_table(manifest: Manifest) -> Table:
    """Blocks, with repeated layers told once: ``0, 3, .. 21 (8)``."""

    def alike(item: tuple[int, BlockRecord]) -> tuple[Any, ...]:
        block = item[1]
        return block.group, block.kind, str(block.type), block.flops, block.reason

    rows = []
    for key, members in groupby(sorted(enumerate(manifest.blocks), key=alike), alike):
        group, kind, type_, cost, reason = key
        told = f"{kind}: {reason}" if reason else kind
        rows.append((of_blocks([index for index, _ in members]), told, type_, str(group), flops(cost)))
    return Table(("block", "kind", "residual", "group", "FLOPs, one evaluation"), tuple(rows))


def of_blocks(indices: Sequence[int]) -> str:
    """Which blocks, told shortly: ``0, 3, .. 21 (8)``."""
    all_of = [str(index) for index in indices]
    return ", ".join(all_of if len(all_of) <= 4 else [*all_of[:2], "..", all_of[-1]]) + f" ({len(all_of)})"


def plans_of(manifest: Manifest) -> dict[str, PlanRecord]:
    """All plans, the dense one first."""
    return {DENSE: PlanRecord("all"), **manifest.plans}


def plan_flops(artifact: Artifact, name: str) -> float | None:
    """FLOPs of a call with a plan; a pruner's blocks cost what was measured on average, None if they were not."""
    own, plan = plans_of(artifact.manifest)[name], artifact.plans[name]
    if own.flops_sparsity is None:
        return None
    manifest = view_of(artifact, plan).manifest
    dense = manifest.flops.call(dense_plan(manifest.steps, len(manifest.blocks)), own.pruned, plan.correction)
    return dense - own.flops_sparsity * manifest.steps * sum(manifest.flops.blocks)


def spare(manifest: Manifest) -> list[str]:
    """Plans that a build keeps for other machines; whatever is the default is none of them."""
    kept = [row["name"] for row in (manifest.calibration or {}).get("frontier", ()) if row.get("spare")]
    return [name for name in kept if name in manifest.plans and name != manifest.default_plan]


def told_spare(manifest: Manifest) -> tuple[str, ...]:
    """Which these are, and what they are for."""
    use = "'ttscompile bench DIR --choose' chooses among them on another machine, or by another deadline"
    return (f"Beside these it has {', '.join(map(repr, names))}: {use}.",) if (names := spare(manifest)) else ()


def plan_table(artifact: Artifact) -> Table:
    """Every plan but spare ones: what it computes, its sparsity, its cost."""
    manifest, rows = artifact.manifest, list[tuple[str, ...]]()
    left_out = spare(manifest)
    for name, own in plans_of(manifest).items():
        if name in left_out:
            continue
        told = f"{name} (default)" if name == manifest.default_plan else marked(name)
        saved = (artifact.plans[name].in_words(), own.kind, share(own.sparsity), share(own.flops_sparsity))
        cost = plan_flops(artifact, name)
        costs = ("", "") if cost is None else (flops(cost), share(cost / manifest.flops.dense))
        rows.append((told, *saved, *costs))
    head = ("plan", "computes", "cells", "reused", "of their FLOPs", "FLOPs a call", "of the original")
    return Table(head, tuple(rows))


def score_table(record: Mapping[str, Any], without: Sequence[str] = ()) -> Table:
    """What calibration measured of plans on episodes that it did not learn from."""
    again = confirmed(record)
    rows = [
        (
            marked(name),
            _figure(score, "distance", ".3f"),
            *[_figure(again, name, ".3f")] * bool(again),
            _figure(score, "error"),
            _figure(score, "error_p90"),
            share(score["sparsity"]),
            share(score["flops_saved"]),
        )
        for name, score in scores(record).items()
        if name not in without
    ]
    distance = ("distance from the original", *["confirmed on other calls"] * bool(again))
    errors = ("mean action error", "90th percentile", "cells reused", "FLOPs saved")
    return Table(("held-out episodes", *distance, *errors), tuple(rows))


def confirmed(record: Mapping[str, Any]) -> dict[str, float]:
    """Distances by name of the plans that a build chose, on calls of the held-out episodes by which it chose none."""
    return {row["name"]: row["confirmed"]["distance"] for row in record.get("frontier", ()) if "confirmed" in row}


def calibration(manifest: Manifest) -> Section:
    """What calibration measured, what that means, and the rest of the record."""
    if (record := manifest.calibration) is None:
        return Section("Calibration", (uncalibrated(manifest),))
    tables, text = [record_table(record)], [*remarks(record)]
    if scores(record):
        held, of = (record.get(key, {}).get("validation") for key in ("calls", "episodes"))
        told = f" ({held} calls of {len(of)} episodes)" if held is not None and of is not None else ""
        errors = f"Errors of the actions, in their units, on recorded episodes that nothing was learned from{told}"
        against = "against the dense policy with the same noise: the mean over calls, and the 90th percentile."
        text.insert(0, f"{errors}, {against}")
        tables.insert(0, score_table(record, spare(manifest)))
    return Section("Calibration", tuple(text) or ("No errors were measured.",), tuple(tables))


def _figure(score: Mapping[str, Any], key: str, form: str = ".4g") -> str:
    """A number of a score; empty where it has none."""
    return "" if score.get(key) is None else format(score[key], form)


def remarks(record: Mapping[str, Any]) -> tuple[str, ...]:
    """What the figures of a calibration mean, in words."""
    noise = "Noise changes nothing here: in its place stands a tenth of what another observation changes."
    unit = [noise] * (record.get("other_noise") == 0)
    timed = [f"The plans were {told}."] if (told := elsewhere(record.get("timed_on"))) else []
    return (*(chosen(record) or verdict(record)), *timed, *unit, *learned(record), *left_out(record))


def chosen(record: Mapping[str, Any]) -> tuple[str, ...]:
    """The verdict of a build on its default plan; where that is the original, on the plan that came nearest."""
    tried, default = record.get("frontier", ()), record.get("default_plan")
    rows, asked = {row.get("name"): row for row in tried}, record.get("budget", {})
    if (row := rows.get(SCHEDULE if default == DENSE else default)) is None:
        return ()
    found = row.get("confirmed", row)  # by calls that it was not chosen by, since builds do that
    told = f"{row['told']}: {found['distance']:.2g} of what other noise changes, {max(found['interval']):.2g} at worst"
    longest = f"{ms(row['worst'])} at {'worst' if row.get('calls', 0) < MANY else 'the 99th percentile'}"
    longest += "" if (deadline := asked.get("latency_ms")) is None else f" of {deadline:.3g} allowed"
    times = f"{ms(row['milliseconds'])} ms a call on the machine that built it, {longest}"
    last = "Not driven yet: evaluate it before a robot moves (examples/evaluation/README.md)."
    if default != DENSE:
        return (f"Chosen among {len(tried)} plans: {told}; {times}. {last}",)
    bound, in_time = asked.get("max_distance", BOUND), " that keeps the deadline" * (deadline is not None)
    none = f"No plan{in_time} is surely within {bound:g} of the original, so the default is {DENSE!r}, which is the"
    none += f" original and takes {ms(rows[DENSE]['milliseconds'])} ms a call. The nearest of {len(tried)} plans is"
    how = f"'ttscompile bench DIR --choose --plan {SCHEDULE}' makes it the default; a build with --error"
    may = f"{rounded_up(row['within'])}, or with more recorded episodes, may."
    return (f"{none} {SCHEDULE!r}, {told}; {times}. {last} {how} {may}",)


def verdict(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Whether the default plan is near enough to the original, as far as a calibration can say."""
    name = record.get("default_plan")
    score = scores(record).get(str(name), {})
    if not isinstance(distance := score.get("distance"), int | float):
        return ()
    if record.get("other_noise") == 0:
        return (f"Plan {name!r} is {distance:.2f} from the original.",)  # what noise changes is no unit here
    where, driven, lost, most = "above a quarter", 37, 20, 68.0
    if distance <= BOUND:
        where, driven, lost, most = "within a tenth", 42, 1, 9.0
    elif distance <= FARTHEST:
        where, driven, lost, most = "within a quarter", 38, 9, 16.5
    told = f"Plan {name!r} is {distance:.2f} from the original, {where} of what other noise changes"
    more = f"Of {driven} such plans that were driven {lost} lost more than 5 points of success, {most} at most"
    return (f"{told}. {more} (docs/evidence/results.md, 'What a distance means').",)


def learned(record: Mapping[str, Any]) -> tuple[str, ...]:
    """What became of what was learned, in the words of what learns it; and that a plan is another network."""
    told = {name: one for name, one in record.get("told", {}).items() if one}
    network = (
        "A plan with weights of its own is another network. So its errors say less about it than those of other plans:"
        " evaluate it on your task."
    )
    return (*(f"Learned, {name}: {one}." for name, one in told.items()), *[network] * ("weights" in told))


def left_out(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Why there is no plan of a name that calibration could have made."""
    return tuple(f"Left out: {name!r}, which {reason}." for name, reason in record.get("skipped", {}).items())


def record_table(record: Mapping[str, Any], most: int = 200) -> Table:
    """The rest of the calibration record, shortened where it is longer than so many characters."""
    rows = []
    for name, value in record.items():
        if name in _NOT_TOLD or value in (None, {}, [], ""):
            continue
        text = plain(value)
        if isinstance(value, list | Mapping) and len(text) > most:
            text = f"{len(value)} entries; ttscompile inspect DIR --json has them"
        rows.append((name.replace("_", " "), text if len(text) <= most else f"{text[:most]}..."))
    return Table(("calibration", ""), tuple(rows), prose=True)


def scores(
    record: Mapping[str, Any] | None, wanted: tuple[str, ...] = ("sparsity", "flops_saved")
) -> Mapping[str, Mapping[str, Any]]:
    """Of each plan that calibration judged, if its figures are there."""
    judged = (record or {}).get("plans", {}).items()
    return {name: score for name, score in judged if all(score.get(key) is not None for key in wanted)}


def limits(artifact: Artifact) -> Section:
    """What a reader should not expect, from the artifact's own facts."""
    manifest = artifact.manifest
    sampler = manifest.spec.sampler
    points = []
    if manifest.calibration is None or manifest.default_plan == DENSE:
        told = "Not calibrated: its" if manifest.calibration is None else "Its"
        points.append(f"{told} default plan computes every cell of its loop.")
    else:
        points.append(
            "Errors are of the actions, on recorded episodes, against the dense policy with the same noise. They are no"
            " success rates: evaluate the plan on your own task before a robot moves."
        )
    if (few := few_steps(manifest)) is not None:
        points.append(few)
    if sampler.stochastic:
        points.append(
            f"The sampler ({sampler.name}) draws noise in every step: two calls on one observation differ, dense"
            " or not. Give reset a seed, or predict_action the noise, to repeat a call."
        )
    if manifest.precision is None:
        points.append("Weights are in fp32. On processors with integer dot products, --precision int8 may be faster.")
    elif plans_of(manifest)[manifest.default_plan].precision:
        points.append(f"It computes in {precision(manifest)}: dense calls differ from those in fp32 as well.")
    if any(plan.pruned for plan in manifest.plans.values()):
        points.append("A plan that is made for each observation costs a different time each call.")
    needs = rollout_needs(view_of(artifact))
    if needs.read:
        points.append(
            f"Its plans read residuals of the call before: {needs.bytes_read / 1e6:.1f} MB a stream are kept, and the"
            " first call after reset() falls back, which its report counts."
        )
    if coarse := [str(i) for i, block in enumerate(manifest.blocks) if block.reason]:
        points.append(f"Blocks {', '.join(coarse)} are coarse: several operations are reused or computed together.")
    points.append("Times are of warm calls of one stream on one machine, taken while this page was made.")
    return Section("Limits", points=tuple(points))
