"""From the name of an artifact to a policy that can be called: ``load``. ``docs/design.md`` section 8."""

import ctypes
from pathlib import Path

from ttscompile.artifact.files import check_file
from ttscompile.artifact.load import Artifact, load_artifact, read_manifest
from ttscompile.artifact.manifest import MANIFEST
from ttscompile.core.paths import on_hub
from ttscompile.core.plan import Plan
from ttscompile.errors import ArtifactChangedError, ArtifactError
from ttscompile.hub import fetch_artifact

from .arrays import check_seed
from .instruct import instruct_of
from .open import open_runtime
from .policy import CompiledPolicy, plan_of

TRIES = 3
"""Times that ``load`` begins before it gives up on an artifact that is replaced while it is loaded."""

_TRIM = getattr(ctypes.pythonapi, "malloc_trim", None)  # glibc's, which keeps what a load needed for a while


def load(
    path: str | Path,
    runtime: str = "onnxruntime",
    threads: int = 1,
    seed: int | None = None,
    *,
    plan: str | Plan | None = None,
    device: str | None = None,
    tokenizer: str | Path | None = None,
) -> CompiledPolicy:
    """Load a compiled policy.

    Args:
        path: the directory that ``convert`` wrote, or the same zipped; or ``hf://org/name[@revision][/folder]``, which
            ``huggingface_hub`` downloads, once. Give a commit as the revision, and it is the same artifact for ever.
        runtime: ``onnxruntime``; ``torch``, which needs torch and computes on any device that it has; or ``reference``,
            which is slow and needs torch.
        threads: threads of arithmetic, of this policy alone. 1 computes on the caller's thread and makes none. With
            more, ``threads - 1`` are made for single blocks and as many for whole steps. They look for work for 50 us
            after each block, and then sleep: a loaded policy that is not called takes no processor time.
        seed: of the noise that is drawn when none is given; None for another sequence every time.
        plan: what ``predict_action`` computes when it is given no plan: the name of a plan of the artifact, ``dense``
            among them, or a ``ttscompile.Plan``; None for the artifact's default.
        device: where torch computes: ``cpu``, ``cuda``, ``cuda:1``, ``mps``. None for the CPU.
        tokenizer: ``tokenizer.json`` of the policy's language model, or its folder: observations may then have the text
            ``task`` in place of tokens, with the package tokenizers. None for the artifact's own, if it has one.

    Raises:
        IllegalPlanError: the artifact has no plan of this name, or lacks what the plan names.
        ObservationError: the tokenizer cannot be had, or the policy has no use for it.
        ArtifactChangedError: the artifact was replaced while it was loaded, and again whenever it was tried again.
        ArtifactError: the artifact is missing, damaged, of another version, or without models of the plan's precision.
        RuntimeUnavailableError: the runtime, or ``huggingface_hub``, cannot be had on this machine; or it cannot do
            what the plan asks for.
        HubError: the repository cannot be had, or holds no artifact.
        TtscompileError: the seed is no whole number of at least 0.
    """
    seed = check_seed(seed)
    origin = None
    if on_hub(path):
        fetched = fetch_artifact(str(path))
        path, origin = fetched.path, fetched.origin

    def once() -> CompiledPolicy:
        return open_policy(load_artifact(path), runtime, threads, seed, plan, device, tokenizer, origin)

    for _ in range(TRIES - 1):
        try:
            return once()
        except ArtifactChangedError:
            continue
        except ArtifactError:
            if origin is None or not _damaged(Path(path)):
                raise
            fetch_artifact(origin, anew=True)  # a file of the cache, where the library looks at names alone
    return once()


def _damaged(folder: Path) -> bool:
    try:
        for name, record in read_manifest(folder).files.items():
            check_file(folder / name, record)
    except ArtifactError:
        return (folder / MANIFEST).is_file()
    return False


def open_policy(
    artifact: Artifact,
    runtime: str = "onnxruntime",
    threads: int = 1,
    seed: int | None = None,
    plan: str | Plan | None = None,
    device: str | None = None,
    tokenizer: str | Path | None = None,
    origin: str | None = None,
) -> CompiledPolicy:
    """The policy of an artifact that is loaded; see ``load`` and ``CompiledPolicy``."""
    wanted = plan_of(artifact, plan)  # refused before the sessions are opened
    opened = open_runtime(artifact, runtime, threads, device, wanted)
    if _TRIM is not None:
        _TRIM(0)
    return CompiledPolicy(artifact, opened, seed, wanted, origin, instruct_of(artifact, tokenizer))
