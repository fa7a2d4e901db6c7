"""What holds of every vision-language-action model that is compiled whole from what lerobot saved."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import ChunkSpec, Noise
from ttscompile.core.tokenizer import Tokenizer, padded
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.lerobot.files import files_beside
from ttscompile.runtimes import open_runtime

from ..rounding import bound
from ..runtimes.agreement import call_terms, largest_difference
from .vlas import CAMERAS, MASK, STATE, TOKENS, Array, as_given


def eager_chunk(
    directory: Path, options: LoadOptions, frame: Mapping[str, Array], noise: Array, tokenizer: Path, task: str
) -> tuple[ChunkSpec, Array]:
    """The whole chunk of the rebuilt network, not compiled, in robot units, given the task's tokens if it reads any."""
    module, spec = load_checkpoint_policy(directory, options=options)
    given = {key: value[None] for key, value in frame.items()}
    if spec.instruction is not None and TOKENS not in given:
        length = spec.observations[TOKENS].shape[0]
        own = Tokenizer(tokenizer, CheckpointError).of_task(task, spec.instruction, length)
        given[TOKENS], given[MASK] = padded([own], length)
    seen = {key: as_given(key, given, spec) for key in spec.observations}
    obs = {key: torch.from_numpy(value) for key, value in seen.items()}
    sample = eager_policy(module, spec)(obs, Noise(noise)).numpy()
    return spec.chunk, spec.chunk.unnormalized(sample, spec.chunk.reference(seen))


def assert_agreement_on_random_plans(compiled: Path, runtime: str) -> None:
    """Two calls of two streams with random legal plans are the reference's, but for rounding."""
    artifact = load_artifact(compiled)
    runtimes = [open_runtime(artifact, name) for name in (runtime, "reference")]
    rng = np.random.default_rng(3)
    assert largest_difference(artifact, runtimes[0], runtimes[1], rng, streams=2, calls=2) < bound(call_terms(artifact))


def assert_a_task_alone_makes_files_of_lerobot(directory: Path, cameras: Sequence[str] = CAMERAS) -> None:
    """None of lerobot's steps writes what is around the instruction."""
    assert not files_beside(directory, load_checkpoint_policy(directory)[1])
    beside = files_beside(directory, load_checkpoint_policy(directory, options=LoadOptions(task="go"))[1])
    assert set(json.loads(beside["config.json"])["input_features"]) == {STATE, *cameras}


def rename_weight(directory: Path, before: str, after: str) -> None:
    """Save a policy's weights with another name for one of them."""
    path = directory / "model.safetensors"
    weights = load_file(path)
    weights[after] = weights.pop(before)
    path.unlink()  # it is mapped
    save_file(weights, path)
