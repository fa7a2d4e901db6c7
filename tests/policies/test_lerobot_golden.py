"""Parity with LeRobot 0.6.1: from raw state, image and tokens to the action, in the loop and in both runtimes."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import nn

import ttscompile
from tests.rounding import PROMISED, Counted, assert_equal_but_for_rounding
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import Noise, PolicySpec
from ttscompile.core.tokenizer import Tokenizer
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.runtimes.instruct import Instruct

from ..families.support import record, stored_program
from .originals import assert_agreement_on_random_plans

pytestmark = pytest.mark.slow

STATE, IMAGE = "observation.state", "observation.images.top"
TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"


@dataclass(frozen=True)
class Golden:
    """One policy that LeRobot saved, and what LeRobot made of it."""

    directory: Path
    family: str
    module: nn.Module
    spec: PolicySpec
    numbers: dict[str, npt.NDArray[Any]]

    @property
    def observation(self) -> dict[str, npt.NDArray[Any]]:
        """The window, raw, one stream."""
        numbers = self.numbers
        return {
            STATE: numbers["state"][None],
            IMAGE: numbers["image"][None],
            TOKENS: numbers["tokens"],
            MASK: numbers["attention_mask"],
        }

    @property
    def noise(self) -> Noise:
        """Of the call; both samplers are deterministic."""
        return Noise(self.numbers["noise_initial"])

    def frame(self, index: int) -> dict[str, Any]:
        """One frame as LeRobot's batch holds it, as tensors, with keys that are no observations."""
        frames = {STATE: self.observation[STATE][:, index], IMAGE: self.observation[IMAGE][:, index]}
        rest = {TOKENS: self.observation[TOKENS], MASK: self.observation[MASK]}
        return {key: torch.from_numpy(value) for key, value in (frames | rest).items()} | {"task": ["push the t"]}


FAMILIES = {
    "multi_task_dit_diffusion_ddim": "LeRobot multi_task_dit, diffusion",
    "multi_task_dit_flow_matching_euler": "LeRobot multi_task_dit, flow matching",
}


@pytest.fixture(scope="module", params=FAMILIES)
def golden(request: pytest.FixtureRequest, shared: Path) -> Golden:
    """A golden policy."""
    directory = shared / "golden" / "lerobot" / request.param
    module, spec = load_checkpoint_policy(directory)
    with np.load(directory.with_suffix(".npz")) as numbers:
        return Golden(directory, FAMILIES[request.param], module, spec, dict(numbers))


@pytest.fixture(scope="module")
def compiled(golden: Golden, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its artifact."""
    directory = tmp_path_factory.mktemp("lerobot") / "compiled"
    ttscompile.convert(golden.directory, directory)
    return directory


def test_single_evaluation(golden: Golden) -> None:
    """The denoiser alone."""
    module: Any = golden.module
    inputs = (torch.from_numpy(golden.numbers[key]) for key in ("probe_x", "probe_t", "condition"))
    with torch.inference_mode(), Counted() as counted:
        found = module.denoiser(*inputs)
    assert_equal_but_for_rounding(found, golden.numbers["probe_out"], counted.terms, counted.angle)


def test_condition(golden: Golden) -> None:
    """Normalisers, crop and both CLIP encoders give LeRobot's condition vector."""
    module: Any = golden.module
    given = {golden.spec.arguments[key]: torch.from_numpy(value) for key, value in golden.observation.items()}
    with torch.inference_mode(), Counted() as counted:
        found = module.encoder(given)
    assert_equal_but_for_rounding(found, golden.numbers["condition"], counted.terms)


def test_whole_call(golden: Golden) -> None:
    """The loop from the stored noise gives the stored chunk, normalised and not."""
    spec, numbers = golden.spec, golden.numbers
    obs = {key: torch.from_numpy(value) for key, value in golden.observation.items()}
    sample = eager_policy(golden.module, spec)(obs, golden.noise).numpy()
    executed = sample[:, spec.chunk.start : spec.chunk.stop]
    assert executed.shape == numbers["action_normalized"].shape
    assert np.abs(executed - numbers["action_normalized"]).max() < PROMISED
    assert spec.chunk.normalizer is not None
    assert np.abs(spec.chunk.normalizer.unnormalize(executed) - numbers["action"]).max() < 1e-4


@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_compiled_call(golden: Golden, compiled: Path, runtime: str) -> None:
    """The artifact from raw observations to the action in its units, within 1e-4."""
    policy = ttscompile.load(compiled, runtime=runtime)
    assert policy.info.observation[TOKENS].dtype == "int64"
    found = policy.predict_action(golden.observation, noise=golden.noise, plan="dense")
    assert np.abs(found["action"] - golden.numbers["action"]).max() < 1e-4


def test_select_action_is_lerobots(golden: Golden, compiled: Path) -> None:
    """Frames one by one: the window is [first, second], and the chunk LeRobot's, action after action."""
    policy, expected = ttscompile.load(compiled), golden.numbers["action"]
    policy.predict_action_chunk(golden.frame(0), noise=golden.noise)
    assert policy.last_report is not None
    found = [policy.select_action(golden.frame(1), noise=golden.noise)]
    first = policy.last_report
    found += [policy.select_action(golden.frame(1)) for _ in range(expected.shape[1] - 1)]
    assert policy.last_report is first  # the rest of the chunk came from the queue
    assert all(isinstance(action, torch.Tensor) and action.shape == (1, 6) for action in found)
    assert np.abs(torch.stack(found, dim=1).numpy() - expected).max() < 1e-4
    policy.select_action(golden.frame(1))
    assert policy.last_report is not first


def test_encoders_and_modulations_leave_the_loop(golden: Golden, compiled: Path) -> None:
    """CLIP runs once a call; of the modulations only an addition is left of each step; K blocks of each kind."""
    program = stored_program(load_artifact(compiled))
    pieces = program.pieces
    table = golden.spec.sampler
    against = "actions that lerobot 0.6.1 gave, raw observation to action, 1e-4"
    record(golden.family, against, f"{table.name} {table.steps}", program)
    steps = [] if pieces.step is None else [node.op for node in pieces.step.nodes]
    assert not any("linear" in op or "attention" in op for op in steps)
    loop = [node.op for piece in pieces.loop.values() for node in piece.graph.nodes]
    assert sum("conv" in op for op in loop) == 0
    assert sum("scaled_dot_product_attention" in op for op in loop) == 4
    kinds = [block.kind for block in ttscompile.load(compiled).info.blocks]
    assert kinds == ["self_attention", "feed_forward"] * 4


def test_runtimes_agree_on_random_plans(golden: Golden, compiled: Path) -> None:
    """Episodes of random legal plans, several streams."""
    assert_agreement_on_random_plans(compiled, calls=3)


def test_a_task_in_words(golden: Golden) -> None:
    """The robot's own text gives LeRobot's tokens, and a text that is too long keeps CLIP's end token."""
    clip = golden.directory.parent / "clip-tiny"
    told = Instruct(golden.spec, partial(Tokenizer, clip))
    mask = golden.numbers["attention_mask"]
    made = told({"task": str(golden.numbers["task"])})
    assert np.array_equal(made[MASK], mask)
    assert np.array_equal(made[TOKENS][mask], golden.numbers["tokens"][mask])
    cut = told({"task": " ".join(["push"] * 200)})
    assert cut[MASK].all() and cut[TOKENS][0, -1] == made[TOKENS][mask][-1]


def test_a_task_that_is_compiled_in(golden: Golden) -> None:
    """The tokenizer's files beside the policy make LeRobot's tokens; the instruction is no observation any more."""
    module, spec = load_checkpoint_policy(golden.directory, options=LoadOptions(task=str(golden.numbers["task"])))
    encoder: Any = module.get_submodule("encoder")
    assert encoder.task_tokens.numpy().tolist() == [golden.numbers["tokens"][golden.numbers["attention_mask"]].tolist()]
    assert encoder.task_mask.all() and encoder.task_mask.shape == encoder.task_tokens.shape
    assert set(spec.observations) == {STATE, IMAGE} and spec.instruction is None
    given = {
        key: torch.from_numpy(golden.observation[key]).expand(3, *spec.observations[key].shape)
        for key in spec.observations
    }
    with torch.inference_mode(), Counted() as counted:
        found = encoder({spec.arguments[key]: value for key, value in given.items()})
    expected = np.broadcast_to(golden.numbers["condition"], found.shape)
    assert_equal_but_for_rounding(found, expected, counted.terms)
