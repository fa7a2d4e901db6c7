"""The compiler, as one straight line: policy -> graph -> pieces -> ONNX -> artifact."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

from torch import nn

from .artifact.write import write_artifact
from .capture import capture
from .config import PolicySpec
from .frontends import load_checkpoint_policy
from .ir.flops import graph_flops
from .ir.program import Program
from .ir.verify import verify
from .lower import lower_program
from .passes.base import Pass
from .passes.clean_up import CleanUp
from .passes.find_residual_blocks import find_residual_blocks
from .passes.hoist import Hoist
from .passes.insert_pruner import InsertPruner
from .passes.insert_reuse import InsertReuse
from .passes.partition import Partition
from .passes.split_tokens import SplitTokens

Explain = Callable[[str, tuple[str, ...]], None]
"""Called with the name of each stage and what it did, one note a line."""


def _silent(stage: str, notes: tuple[str, ...]) -> None:
    """Explain nothing."""


def convert(
    checkpoint: str | os.PathLike[str],
    directory: str | os.PathLike[str],
    *,
    format: str = "auto",
    sampler: str | None = None,
    steps: int | None = None,
    spacing: str | None = None,
    explain: Explain = _silent,
) -> Program:
    """Compile a trained policy and write the artifact; its plan is dense until it is calibrated.

    Args:
        checkpoint: a file or directory that the training code saved.
        directory: where the artifact goes; an artifact that is there is replaced, anything else is left alone.
        format: ``auto`` or ``diffusion_policy``.
        sampler: ``ddpm`` or ``ddim`` in place of the checkpoint's own; None keeps it.
        steps: number of denoising steps; None keeps the checkpoint's.
        spacing: ``leading``, ``trailing`` or ``linspace``: the timesteps that fewer steps visit; None: as trained.
        explain: told what each stage did.

    Raises:
        TtscompileError: the checkpoint is refused, its network cannot be compiled, or the artifact cannot be written.
    """
    module, spec = load_checkpoint_policy(checkpoint, format=format, sampler=sampler, steps=steps, spacing=spacing)
    return compile_denoiser(module, spec, directory, explain=explain)


def compile_denoiser(
    module: nn.Module,
    spec: PolicySpec,
    directory: str | os.PathLike[str] | None = None,
    *,
    explain: Explain = _silent,
) -> Program:
    """Compile any denoiser that ``torch.export`` can capture.

    Args:
        module: ``eps(sample, timestep, **observations)``, see ``ttscompile.PolicySpec``; observations come normalised.
        spec: the policy beside its network.
        directory: where the artifact goes; None compiles without writing.
        explain: told what each stage did.

    Returns:
        The compiled program.

    Raises:
        TtscompileError: it cannot be captured, it has no residual blocks, or the artifact cannot be written.
    """
    program = transform(module, spec, explain=explain)
    if directory is not None:
        models = lower_program(program)
        explain("lower", (f"{len(models)} ONNX models",))
        manifest = write_artifact(program, models, directory)
        explain("write", (f"identity {manifest.identity[:12]}",))
    return program


def transform(module: nn.Module, spec: PolicySpec, *, explain: Explain = _silent) -> Program:
    """Everything up to lowering: capture, analysis and passes."""
    graph, weights = capture(module, spec)
    megabytes = sum(w.nbytes for w in weights.values()) / 1e6
    explain("capture", (f"{len(graph.nodes)} operations, {megabytes:.1f} MB of weights",))
    program = Program(spec, graph, weights, dense_flops=graph_flops(graph) * spec.sampler.steps)
    verify(program)
    program = _run(CleanUp(), program, explain)
    table = find_residual_blocks(program.denoiser, spec.sample_argument)
    kinds = ", ".join(dict.fromkeys(block.kind for block in table.blocks))
    explain("find_residual_blocks", (f"{len(table.blocks)} blocks: {kinds}", *table.declined))
    program = replace(program, blocks=table.blocks)
    for each in (Partition(), SplitTokens(), CleanUp(), Hoist(), InsertPruner(), InsertReuse(), CleanUp()):
        program = _run(each, program, explain)
    verify(program)
    return program


def _run(each: Pass, program: Program, explain: Explain) -> Program:
    result = each(program)
    explain(each.name, result.notes)
    return result.program
