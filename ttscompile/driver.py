"""The compiler, as one straight line: policy -> graph -> pieces -> ONNX -> artifact."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from torch import nn

from .artifact.bind import LoweredPieces
from .artifact.files import replace_file
from .artifact.write import require_replaceable, write_artifact
from .capture.export import capture
from .capture.narrow import narrow, needed, unneeded
from .core.coercion import integer
from .core.paths import on_hub, require_free_or_path
from .core.spec import FP32, ORIGINAL, PolicySpec
from .core.untrusted_json import NOT_SHOWN
from .errors import ArtifactError, NoResidualBlocksError, PassError, SpecError
from .frontends import files_beside, load_checkpoint_policy, tokenizer_of
from .frontends.encoded import own_copy, parts
from .frontends.examined import examine
from .frontends.families import LoadOptions
from .hub import fetch_checkpoint
from .ir.dataflow import reachable_from
from .ir.flops import graph_flops, node_flops
from .ir.graph import Graph
from .ir.pieces import is_block
from .ir.program import Captured, Cut, Program
from .ir.verify import verify
from .lower.joint import lower_all_blocks
from .lower.precision import lower_precision, parts_to_lower, require_precision
from .lower.program import lower_program
from .lower.single_file import lower_single_file
from .passes.base import After, Before, Pass
from .passes.clean_up import CleanUp
from .passes.cut_copies import CutCopies
from .passes.find_residual_blocks import BlockTable, find_residual_blocks
from .passes.hoist import Hoist
from .passes.insert_pruner import InsertPruner
from .passes.move_skip import MoveSkip, skips_network
from .passes.one_block import OneBlock
from .passes.partition import Partition
from .passes.regroup_sums import RegroupSums
from .passes.reuse_tokens import ReuseTokens
from .passes.split_frames import SplitFrames
from .passes.split_tokens import SplitFeatures, SplitStem, SplitTokens
from .passes.unfold_batch import UnfoldBatch
from .passes.widen_attention import WidenAttention
from .passes.write_sums import WriteSums
from .verification.record_golden import record_original

if TYPE_CHECKING:
    from onnx import ModelProto

    Models = Mapping[str, ModelProto]

Explain = Callable[[str, tuple[str, ...]], None]
"""Called with the name of each stage and what it did, one note a line."""


@dataclass(frozen=True)
class _Output:
    """What is written of a program: arguments of ``convert`` and of ``write_artifact``, by the same names.

    The single file is of ``loop``.
    """

    directory: str | os.PathLike[str] | None
    single_file: str | os.PathLike[str] | None
    precision: str
    keep_fp32: Collection[str]
    loop: str = ORIGINAL
    beside: Mapping[str, bytes] | None = None
    tokenizer: bytes | None = None

    def __post_init__(self) -> None:
        require_precision(self.precision, self.keep_fp32)
        if self.single_file is not None:
            _require_apart(self.single_file, self.directory)


def convert(
    checkpoint: str | os.PathLike[str],
    directory: str | os.PathLike[str],
    *,
    format: str = "auto",
    sampler: str | None = None,
    steps: int | None = None,
    spacing: str | None = None,
    loops: Sequence[tuple[str, int]] = (),
    task: str | None = None,
    encoders: str | os.PathLike[str] | None = None,
    without_cameras: Sequence[str] | None = None,
    base: str | os.PathLike[str] | None = None,
    prediction_horizon: int | Literal["needed"] | None = None,
    precision: str = FP32,
    keep_fp32: Collection[str] = (),
    single_file: str | os.PathLike[str] | None = None,
    explain: Explain = lambda stage, notes: None,
    read: Callable[[PolicySpec], None] = lambda spec: None,
) -> Program:
    """Compile a trained policy and write the artifact; its plan is dense until it is calibrated.

    Args:
        checkpoint: a file or directory that the training code saved; or ``hf://org/name[@revision][/path]``, which
            ``huggingface_hub`` downloads, once. The artifact says from which commit it is, and under which licence.
        directory: where the artifact goes; an artifact that is there is replaced, anything else is left alone.
        format: name of the policy's family, ``diffusion_policy`` or ``lerobot``; ``auto`` tells by what is there.
        sampler: ``ddpm``, ``ddim`` or ``dpmsolver++`` of a policy that was trained with diffusion, ``euler`` or ``rk4``
            of one that was trained with flow matching: a loop beside the policy's own. None: its own sampler.
        steps: number of denoising or integration steps of that loop; None: as many as the checkpoint's own has.
            ``rk4`` evaluates the network four times a step: K = 4 ``steps``.
        spacing: ``leading``, ``trailing`` or ``linspace``: the timesteps that fewer steps visit. None: the checkpoint's
            own, or diffusers' default (``leading`` of DDIM); of ``dpmsolver++`` in place of another sampler
            ``trailing``, or ``leading`` for a policy that predicts noise without a bound on the sample.
        loops: further loops, by sampler and number of steps, for calibration to choose among; plan ``full`` is then of
            the policy's own. Those that a policy of its kind cannot have are left out.
        task: of a LeRobot policy: the one instruction that is compiled in, so that the robot needs no tokenizer; None
            makes its tokens an observation.
        encoders: folder with what a checkpoint names and does not hold: CLIP, SigLIP, a language model's configuration
            (and tokenizer, for ``task``), where it is neither in nor beside the checkpoint. Nothing is ever downloaded.
        without_cameras: of a vision-language-action model: names of cameras that it was trained with and that the robot
            lacks. None leaves out only those that lerobot calls empty.
        base: of a LoRA adapter: directory or ``hf://org/name`` of what it adapts; None for what its configuration says.
        prediction_horizon: predict only the first so many steps of the policy's horizon; see ``compile_denoiser``.
            ``needed``: as many as a robot needs, where no action depends on those after it; all where some does.
        precision: of the weights: ``fp32``, ``int8`` or ``int4``; see ``compile_denoiser``.
        keep_fp32: what stays in fp32 beside another precision; see ``compile_denoiser``.
        single_file: where one ONNX file of the whole call goes too, for programs without ttscompile; None for none. It
            is of the loop that is asked for, or else of the policy's own. ``ttscompile.lower.single_file`` describes
            its inputs and outputs.
        explain: told what each stage did.
        read: told what was read, before minutes of work; an error of it ends them.

    Raises:
        TtscompileError: the checkpoint is refused, its network cannot be compiled, or the artifact cannot be written.
    """
    require_precision(precision, keep_fp32)  # before minutes of work
    require_replaceable(directory)
    if task is not None and (found := NOT_SHOWN.search(task)):
        raise SpecError(
            f"the task {task!a:.100} has the character {found[0]!a}, which a terminal does not show, and an artifact"
            " keeps no such text. Leave it out, or give the instruction at every call."
        )
    origin: dict[str, str] = {}
    if on_hub(checkpoint):
        fetched = fetch_checkpoint(str(checkpoint))
        checkpoint, origin = fetched.path, {"base": fetched.origin}
        if fetched.licence is not None:
            origin["base_licence"] = fetched.licence
    options = LoadOptions(sampler, steps, spacing, task, encoders, without_cameras, tuple(loops) or None, base)
    module, spec = load_checkpoint_policy(checkpoint, format, options)
    read(spec)
    for one in examine(Path(checkpoint), spec, encoders):
        if one.remedy:
            warnings.warn(one.told, stacklevel=2)
    spec = replace(spec, source={**spec.source, **origin})
    tokenizer, words = tokenizer_of(checkpoint, spec, encoders)
    beside = files_beside(checkpoint, spec, tokenizer is not None)
    if beside == {}:
        explain("files_beside", ("none: no step of its program makes the tokens that this policy reads",))
    if spec.instruction is not None:
        explain("tokenizer_of", (words,))
    loop = ORIGINAL if loops else next(iter(spec.loops), ORIGINAL)
    output = _Output(directory, single_file, precision, keep_fp32, loop, beside, tokenizer)
    return _compile(module, spec, prediction_horizon, output, explain)


def compile_denoiser(
    module: nn.Module,
    spec: PolicySpec,
    directory: str | os.PathLike[str] | None = None,
    *,
    prediction_horizon: int | None = None,
    precision: str = FP32,
    keep_fp32: Collection[str] = (),
    single_file: str | os.PathLike[str] | None = None,
    explain: Explain = lambda stage, notes: None,
) -> Program:
    """Compile any denoiser that ``torch.export`` can capture.

    Args:
        module: ``eps(sample, timestep, **observations)``, see ``ttscompile.PolicySpec``; observations come normalised.
        spec: the policy beside its network.
        directory: where the artifact goes; None compiles without writing.
        prediction_horizon: predict only the first so many steps of the sample: less to compute at every step, with the
            same actions, where attention is causal. Refused where it is not. None predicts all.
        precision: of the weights of residual blocks and of the prologue, image encoders above all: ``fp32``, or
            ``int8``, which is faster on processors with integer dot products; or ``int4``, which is smaller: four bits
            in blocks and prefix, and eight in image encoders. Plan ``full`` then computes in it; fp32
            stays in the artifact too, for plan ``dense``. What it does to the actions is not measured here:
            ``calibrate(..., learn=("precision",))`` does, and leaves out the parts that change them too much.
        keep_fp32: parts that stay in fp32 whatever the precision: ``blocks``; ``prologue``, or a piece of it by name,
            ``frame_00``, ``scene``, ``condition`` or ``step``.
        single_file: see ``convert``; of the policy's own loop.
        explain: told what each stage did.

    Raises:
        TtscompileError: it cannot be captured, it has no residual blocks, or the artifact cannot be written.
    """
    module = own_copy(module)  # the program, which is returned, shares memory with it
    output = _Output(directory, single_file, precision, keep_fp32)
    return _compile(module, spec, prediction_horizon, output, explain)


def _compile(
    module: nn.Module,
    spec: PolicySpec,
    prediction_horizon: int | Literal["needed"] | None,
    output: _Output,
    explain: Explain,
) -> Program:
    """See ``compile_denoiser``. Nobody else may change the module: the program shares memory with it."""
    if prediction_horizon == "needed":
        prediction_horizon = needed(module, spec)
    elif prediction_horizon is not None:
        prediction_horizon = integer(prediction_horizon, "prediction_horizon", SpecError, 1)
    if prediction_horizon is not None or spec.left_out:
        kept = spec.sample[0] if prediction_horizon is None else prediction_horizon
        spec, changed = narrow(module, spec.whole_horizon, kept)
        told = f"{kept} of {spec.whole_horizon.sample[0]} steps are predicted"
        explain("narrow", (f"{told}; they differ from the original's by {changed:.1g} of their deviation",))
    program = transform(module, spec, explain=explain)
    if prediction_horizon is None and (hint := unneeded(module, spec)) is not None:
        explain("narrow", (hint,))
    if output.directory is not None or output.single_file is not None:
        _write(program, module, output, explain)
    return program


def _write(program: Program, module: nn.Module, output: _Output, explain: Explain) -> None:
    """Lower a program, and write it: as an artifact, as a single file, or as both."""
    precision, loop, loops = output.precision, output.loop, program.spec.loops
    models = lower_program(program)
    explain("lower", (f"{len(models)} ONNX models",))
    lowered = None if precision == FP32 else _lower_pieces(program, models, precision, output.keep_fp32, explain)
    whole: bytes | None = None
    if output.single_file is not None:  # made before anything is written: without one there is no artifact either
        own, weights = ({}, {}) if lowered is None else (lowered.models, lowered.weights)
        model = lower_single_file(program, {**models, **own}, {**program.weights, **weights}, loop)
        whole = model.SerializeToString(deterministic=True)
    if output.directory is not None:
        golden = record_original(module, program)
        told = f"{len(golden.steps)} of {program.spec.sampler.steps} steps, {golden.streams} streams"
        further = (f"{name}: {len(golden.loops[name].steps)} of {table.steps}" for name, table in loops.items())
        explain("record_original", (told, *further))
        more = output.beside or {}, loop, output.tokenizer
        manifest = write_artifact(program, models, output.directory, lowered, golden, *more)
        explain("write", (f"identity {manifest.short_identity}",))
    if whole is not None and output.single_file is not None:
        file = Path(output.single_file)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            replace_file(file, whole)
        except OSError as error:
            told = f"the single file cannot be written: {error}"
            raise ArtifactError(f"{output.single_file}: {told}. Give another path.") from error
        other = "reuse tokens, " * bool(program.pieces.tokens) + "have weights of their own or begin with"
        told = f"it runs plans of loop {loop!r} in {precision}, but none that {other} the chunk of the call before"
        explain("write_single_file", (f"{len(whole) / 1e6:.1f} MB", f"{told}: ttscompile.load runs these"))


def _require_apart(single_file: str | os.PathLike[str], directory: str | os.PathLike[str] | None) -> None:
    """Raise unless a single file can be written there, and is no part of the artifact, which is replaced as a whole."""
    other = "Give another path for the single file."
    require_free_or_path(single_file, ArtifactError, other)
    file = Path(os.path.realpath(single_file))
    if file.is_dir():
        raise ArtifactError(f"{single_file}: expected a file, or nothing; found a directory. {other}")
    if directory is not None and Path(os.path.realpath(directory)) in (file, *file.parents):
        problem = f"expected a path outside of the artifact {os.fspath(directory)}, which is replaced as a whole"
        raise ArtifactError(f"{single_file}: {problem}. {other}")


def _lower_pieces(
    program: Program, models: Models, precision: str, keep_fp32: Collection[str], explain: Explain
) -> LoweredPieces:
    """Blocks and prologue in eight or four bits. What that changes is not known here: calibration measures it."""
    parts, asked, staying = parts_to_lower(program, keep_fp32)
    own, weights, notes = lower_precision(models, program.weights, precision, parts)
    if any(map(is_block, own)):
        own |= lower_all_blocks(program.pieces.blocks, {**models, **own})
    explain("lower_precision", (*notes, *staying))
    return LoweredPieces(precision, own, weights, asked)


def transform(module: nn.Module, spec: PolicySpec, *, explain: Explain = lambda stage, notes: None) -> Program:
    """Everything up to lowering: capture, analysis and passes. Weights share memory with the module's parameters."""
    graph, weights = capture(module, spec)
    megabytes = sum(w.nbytes for w in weights.values()) / 1e6
    explain("capture", (f"{len(graph.nodes)} operations, {megabytes:.1f} MB of weights",))
    whole = capture(module, spec.whole_horizon)[0] if spec.left_out else graph
    once = _encoder_flops(module, whole, spec)
    dense = (graph_flops(whole) - once) * spec.sampler.steps + once
    captured = Captured(spec, graph, weights, dense_flops=dense, once_flops=once)
    verify(captured)
    clean = CleanUp[Captured]()
    for simplify in (clean, CutCopies(), WidenAttention(), SplitStem(), clean, WriteSums(), RegroupSums()):
        captured = _run(simplify, captured, explain)
    captured, table = _find_blocks(captured, explain)
    cut = _run(Partition(table.blocks), captured, explain)
    for split in (UnfoldBatch(), SplitTokens(), SplitFeatures(), CleanUp[Cut]()):
        cut = _run(split, cut, explain)
    program = _run(Hoist(), cut, explain)
    for finish in (InsertPruner(), SplitFrames(), CleanUp[Program](), ReuseTokens()):
        program = _run(finish, program, explain)
    return program


def _find_blocks(captured: Captured, explain: Explain) -> tuple[Captured, BlockTable]:
    """The residual blocks of the network; or the whole network as one, where no chain of them holds most of it."""
    sample = captured.spec.sample_argument
    if skips_network(captured.denoiser, sample) and _finer_inside(captured):
        captured = _run(MoveSkip(), captured, explain)
    try:
        table = find_residual_blocks(captured.denoiser, sample)
    except NoResidualBlocksError as error:
        captured = _run(OneBlock(str(error)), captured, explain)
        table = find_residual_blocks(captured.denoiser, sample)
    explain("find_residual_blocks", table.notes)
    return captured, table


def _finer_inside(captured: Captured) -> bool:
    """Whether a network that predicts the sample plus more has several blocks in what it adds, and one without."""
    counts = []
    for each in (captured, MoveSkip()(captured).program):
        try:
            counts.append(len(find_residual_blocks(each.denoiser, each.spec.sample_argument).blocks))
        except NoResidualBlocksError:
            counts.append(1)
    whole, inside = counts
    return whole == 1 < inside


def _encoder_flops(module: nn.Module, graph: Graph, spec: PolicySpec) -> int:
    """FLOPs of what the original evaluates once a call, and not at every step: its observation encoder."""
    if parts(module).encoder is None:
        return 0
    types, loop = graph.types(), reachable_from(graph, [spec.sample_argument, spec.timestep_argument])
    return sum(node_flops(node, types) for node in graph.nodes if node.name not in loop)


def _run(each: Pass[Before, After], program: Before, explain: Explain) -> After:
    result = each(program)
    try:
        verify(result.program)
    except PassError as error:
        raise PassError(f"after {each.name}: {error}") from error
    explain(each.name, result.notes)
    return result.program
