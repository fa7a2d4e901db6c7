"""What holds of every policy that is read as its authors' code saved it."""

from pathlib import Path

import numpy as np
from click.testing import CliRunner

import ttscompile
from tests.families.checks import Arrays, rounded
from tests.rounding import assert_equal_but_for_rounding
from ttscompile.cli import main
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions, find_family
from ttscompile.runtimes.policy import CompiledPolicy


def by_one_command(path: Path, *words: str) -> Path:
    """Compile a checkpoint of a folder into ``compiled`` there, and give that."""
    compiled = path.parent / "compiled"
    result = CliRunner().invoke(main, ["convert", str(path), "-o", str(compiled), *words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return compiled


def assert_acts_as_the_original(
    path: Path, compiled: Path, observed: Arrays, noise: np.ndarray, actions: np.ndarray, part: str = "action"
) -> tuple[CompiledPolicy, np.ndarray]:
    """With the runtime of the robot, from raw observations to actions.

    Args:
        path: of the checkpoint.
        compiled: its artifact.
        observed: by the policy, of all streams.
        noise: ``[B, T, D]``, which the original drew.
        actions: of the original; those executed, or with ``action_pred`` as ``part`` the whole chunk.
        part: of what the policy gives.

    Returns:
        The policy, and its actions.
    """
    policy = ttscompile.load(compiled, runtime="onnxruntime")
    made = policy.predict_action(observed, noise=ttscompile.Noise(noise), plan="dense")[part]
    module, spec = load_checkpoint_policy(path)
    assert_equal_but_for_rounding(made, actions, *rounded(module, observed, spec))
    return policy, made


def assert_loops(path: Path, own: tuple[str, int, int], asked: tuple[str, int], format: str) -> ttscompile.PolicySpec:
    """The loop is the configuration's, beside the one that is asked for; and the family is found, and has its name.

    Args:
        path: of the checkpoint.
        own: name, steps and first timestep of the configuration's loop.
        asked: sampler and steps of the other.
        format: name of the family.
    """
    spec = load_checkpoint_policy(path, options=LoadOptions(sampler=asked[0], steps=asked[1]))[1]
    assert (spec.sampler.name, spec.sampler.steps, spec.sampler.timesteps[0]) == own
    assert [(each.name, each.steps) for each in spec.loops.values()] == [asked]
    assert find_family(path, "auto").name == find_family(path, format).name == format
    return spec
