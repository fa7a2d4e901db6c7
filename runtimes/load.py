"""From the name of an artifact to a policy that can be called: ``load``. ``docs/design.md`` section 8."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.core.paths import on_hub
from ttscompile.core.spec import FP32
from ttscompile.errors import ArtifactChangedError, RuntimeUnavailableError
from ttscompile.hub import fetch_artifact

from .arrays import check_seed
from .instruct import Instruct
from .open import kind_of, open_runtime
from .policy import CompiledPolicy, require_plan
from .warm_start import WarmPolicy, settled_steps

TRIES = 3
"""Times that ``load`` begins before it gives up on an artifact that is replaced while it is loaded."""


def load(
    path: str | Path,
    runtime: str = "onnxruntime",
    threads: int = 1,
    seed: int | None = None,
    *,
    precision: str | None = None,
    plan: str | None = None,
    device: str | None = None,
    tokenizer: str | Path | None = None,
    reuse_tokens: bool = True,
    warm: int | bool | None = None,
) -> CompiledPolicy:
    """Load a compiled policy.

    Args:
        path: the directory that ``convert`` wrote, or the same zipped; or ``hf://org/name[@revision][/folder]``, which
            ``huggingface_hub`` downloads, once. Give a commit as the revision, and it is the same artifact for ever.
        runtime: ``onnxruntime``; ``torch``, which needs torch and computes on any device that it has; or ``reference``,
            which is slow and needs torch.
        threads: threads of arithmetic, of this policy alone. 1 computes on the caller's thread and makes none. With
            more, ``threads - 1`` of them look for work for 50 us after each block, and then sleep: a loaded policy that
            is not called takes no processor time.
        seed: of the noise that is drawn when none is given; None for another sequence every time.
        precision: of blocks and prologue. ``fp32`` is what every artifact holds; None for what it was converted with.
            Torch computes the products of the blocks in ``fp32``, which is what None means there, ``bf16`` or
            ``fp16``; the reference in fp32 alone.
        plan: that ``predict_action`` uses when it is given none: ``dense`` or the name of a plan of the artifact; None
            for the artifact's default.
        device: where torch computes: ``cpu``, ``cuda``, ``cuda:1``, ``mps``. None for the CPU.
        tokenizer: ``tokenizer.json`` of the policy's language model, or its folder: observations may then have the text
            ``task`` in place of tokens. Needs the package tokenizers. None: the caller gives tokens.
        reuse_tokens: of new frames compute the tokens whose patches changed, as ``ttscompile.reuse_tokens`` has settled
            it for the artifact; where it has not, and in other runtimes, all are computed. False computes all.
        warm: how many steps at the end of the loop a call computes that begins with the chunk of the call before; True
            for as many as ``ttscompile.warm_start`` has settled. All calls of an episode but the first do so then, and
            each has to be one chunk later than the one before (``docs/howto/warm-start.md``). These steps are dense: a
            plan is of calls that compute the whole loop. None or False: every call begins with noise.

    Raises:
        IllegalPlanError: the artifact has no plan of this name.
        ObservationError: the tokenizer cannot be had, or the policy has no use for it.
        ArtifactChangedError: the artifact was replaced while it was loaded, and again whenever it was tried again.
        ArtifactError: the artifact is missing, damaged, of another version, or without blocks of this precision; or
            ``warm`` is True and nothing was settled.
        SpecError: ``warm`` is no number of steps below those of the loop, or this sampler has no such start.
        RuntimeUnavailableError: the runtime, or ``huggingface_hub``, cannot be had on this machine.
        HubError: the repository cannot be had, or holds no artifact.
        TtscompileError: the seed is no whole number of at least 0.
    """
    seed = check_seed(seed)
    origin = None
    if on_hub(path):
        fetched = fetch_artifact(str(path))
        path, origin = fetched.path, fetched.origin

    def once() -> CompiledPolicy:
        artifact = load_artifact(path)
        artifact = artifact if reuse_tokens else artifact.with_reuse(None)
        return open_policy(artifact, runtime, threads, seed, precision, plan, device, tokenizer, origin, warm)

    for _ in range(TRIES - 1):
        with suppress(ArtifactChangedError):
            return once()
    return once()


def open_policy(
    artifact: Artifact,
    runtime: str = "onnxruntime",
    threads: int = 1,
    seed: int | None = None,
    precision: str | None = None,
    plan: str | None = None,
    device: str | None = None,
    tokenizer: str | Path | None = None,
    origin: str | None = None,
    warm: int | bool | None = None,
) -> CompiledPolicy:
    """The policy of an artifact that is loaded; see ``load``, ``CompiledPolicy`` and ``WarmPolicy``."""
    made, own = kind_of(runtime).precisions, FP32
    if made:
        if precision is not None and precision not in made:
            those = ", ".join(map(repr, made))
            problem = f"runtime {runtime!r} computes in {those} alone; found precision {precision!r}"
            raise RuntimeUnavailableError(f"{problem}. Leave it out.")
        own, precision = precision or FP32, FP32
    if precision is not None:
        artifact = artifact.at_precision(precision)
    if plan is not None:
        require_plan(artifact, plan)  # before the sessions are opened
    opened = open_runtime(artifact, runtime, threads, device, own, plan)
    instruct = None if tokenizer is None else Instruct(artifact.manifest.spec, tokenizer)
    arguments = (artifact, opened, seed, plan, own if made else None, origin, instruct)
    if warm is None or warm is False:
        return CompiledPolicy(*arguments)
    return WarmPolicy(*arguments, last_steps=settled_steps(artifact) if warm is True else warm)
