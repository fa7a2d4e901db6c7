"""Diffusion BC from the weights of a training, to the actions that the original gave; see ``bc.py``."""

import re
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families.checks import golden
from tests.families.support import record
from tests.rounding import PROMISED
from ttscompile.errors import SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions, find_family

from . import bc
from .authors import by_one_command
from .refused import assert_not_read

SHOWN = "image_transformer"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "convert.md"


def noise(variant: str, steps: int) -> ttscompile.Noise:
    """As the original drew it: the initial sample first, then one for each step but those at the last timestep."""
    drawn = bc.draws(variant)[:, :, None]
    return ttscompile.Noise(drawn[0], np.roll(drawn, -1, 0)[:steps])


def near(actions: np.ndarray, expected: np.ndarray) -> bool:
    """Whether actions are the original's, as the support table promises it."""
    return bool(np.abs(actions - expected).max() < PROMISED * np.ptp(expected))


def extended(variant: str) -> int:
    """Steps of Diffusion-X."""
    return bc.VARIANTS[variant].timesteps + bc.EXTRA


@pytest.mark.parametrize("variant", bc.VARIANTS)
def test_the_original_gave_the_same(variant: str, tmp_path: Path) -> None:
    """What the network predicts at the first timestep and at the last, and the actions of both loops."""
    path, numbers = bc.save(tmp_path / "bc.pt", variant), bc.expected(variant)
    module, spec = load_checkpoint_policy(path, options=LoadOptions(steps=extended(variant)))
    seen = {name: torch.from_numpy(value) for name, value in bc.observation(variant).items()}
    sizes = bc.VARIANTS[variant]
    with torch.inference_mode():
        first, timesteps = torch.from_numpy(bc.draws(variant)[0, :, None]), torch.tensor([sizes.timesteps, 1])
        prediction = module(first, timesteps, **seen)[:, 0].numpy()
    assert near(prediction, numbers["prediction"])
    for loop, steps, name in (
        ("original", sizes.timesteps, "sample"),
        (f"diffusion-x-{extended(variant)}", extended(variant), "extra"),
    ):
        actions = eager_policy(module, spec.in_loop(loop))(seen, noise(variant, steps))[:, 0].numpy()
        assert near(actions, numbers[name]), loop
    assert not near(numbers["sample"], numbers["extra"])
    assert spec.source["variant"] == ("MLP" if sizes.hidden else "transformer")


@pytest.mark.slow
def test_one_command_compiles_a_policy_that_acts_as_the_original(tmp_path: Path) -> None:
    """From images of 0..1 to actions, as trained and as Diffusion-X, in both runtimes."""
    compiled = by_one_command(bc.save(tmp_path / "claw.pt", SHOWN), "--steps", str(extended(SHOWN)))
    for runtime in ("onnxruntime", "reference"):
        policy = ttscompile.load(compiled, runtime=runtime)
        for plan, steps, name in (("dense", 10, "sample"), ("full", extended(SHOWN), "extra")):
            out = policy.predict_action(bc.observation(SHOWN), noise=noise(SHOWN, steps), plan=plan)
            assert near(out["action"][:, 0], bc.expected(SHOWN)[name]), (runtime, plan)
    assert policy.info.observation["image"].shape == (3, 32, 32)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["MLP", "transformer"])
def test_what_is_said_of_them(kind: str, tmp_path: Path) -> None:
    """Their rows of the support table, of a state: an image's encoder would be most of what leaves so small a loop."""
    program = ttscompile.convert(bc.save(tmp_path / "bc.pt", f"states_{kind.lower()}"), tmp_path / "compiled")
    record(
        f"Diffusion BC (Pearce et al.), {kind}",
        "Imitating-Human-Behaviour-w-Diffusion 41e75ef `sample`, `sample_extra`, 1e-5 of the range",
        f"ddpm {program.spec.sampler.steps}",
        program,
    )


def test_other_files_that_hold_the_same_policy(tmp_path: Path) -> None:
    """Beside an optimizer's state, of a wrapped module, and of an older one in half precision."""
    variant = "states_mlp"
    module, spec = load_checkpoint_policy(bc.save(tmp_path / "bc.pt", variant))
    expected = module.state_dict()
    other, same = load_checkpoint_policy(bc.save(tmp_path / "b.ckpt", variant, wrapped=True))
    torch.testing.assert_close(other.state_dict(), expected, rtol=0, atol=0)
    assert same.sampler.same_as(spec.sampler)
    saved = torch.load(tmp_path / "bc.pt")
    for wrapper in ("module.", "_orig_mod.", "_orig_mod.module.", "module._orig_mod."):
        torch.save({f"{wrapper}{name}": value for name, value in saved.items()}, tmp_path / "c.pth")
        found = load_checkpoint_policy(tmp_path / "c.pth")[0].state_dict()
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
    changed = {name: value.half() if name.startswith("nn_model.") else value for name, value in saved.items()}
    torch.save(changed, tmp_path / "d.pth")
    halved = {name: value.half().float() for name, value in expected.items()}
    torch.testing.assert_close(load_checkpoint_policy(tmp_path / "d.pth")[0].state_dict(), halved, rtol=0, atol=0)
    assert find_family(tmp_path / "d.pth", "auto").name == find_family(tmp_path / "d.pth", "diffusion_bc").name


def test_another_sampler_never_evaluates_at_a_timestep_of_no_training(tmp_path: Path) -> None:
    """Timestep 0 is none of theirs, and the last step adds no noise."""
    path = bc.save(tmp_path / "bc.pt", "image_mlp")
    for options, name in (
        (LoadOptions(sampler="ddim", steps=5), "ddim-5"),
        (LoadOptions(sampler="ddpm", steps=5), "ddpm-5"),
        (LoadOptions(sampler="dpmsolver++", steps=5), "dpmsolver++-5"),
    ):
        spec = load_checkpoint_policy(path, options=options)[1]
        table = spec.loops[name]
        assert table.timesteps.min() >= 1
        assert table.timesteps.max() <= 50
        assert table.noise_to_next[-1] == 0
        assert table.stochastic == (name == "ddpm-5")
    for options, message in (
        (LoadOptions(sampler="ddim", steps=60), "60"),
        (LoadOptions(sampler="euler"), "none of a policy that was trained with diffusion"),
        (LoadOptions(steps=1001), "1001 denoising steps are not possible; expected 1000 at most"),
    ):
        assert_not_read(path, message, error=SpecError, options=options)


def test_the_likeliest_of_many_is_the_one_that_scikit_learn_chooses() -> None:
    """Diffusion-KDE, as the page writes it."""
    text = PAGE.read_text(encoding="utf-8")
    blocks = [each for each in re.findall(r"```py\n(.*?)```", text, re.S) if "np.exp" in each]
    assert len(blocks) == 1
    drawn = golden("diffusion_bc")["kde.drawn"]

    class Policy:
        def predict_action(self, observation: Any) -> Any:
            assert observation["image"].shape == (len(drawn), 3, 32, 32)
            return {"action": drawn[:, None]}

    names: dict[str, Any] = {"np": np, "policy": Policy(), "image": np.zeros((3, 32, 32), np.float32)}
    exec(textwrap.dedent(blocks[0]), names)
    assert (names["action"] == drawn[int(golden("diffusion_bc")["kde.chosen"])]).all()


NET = "nn_model.fc2.0.model.0.weight"
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({NET: None}, rf"missing {NET}"),
    ({NET: torch.zeros(24, 3)}, rf"{NET} has shape \(24, 3\); expected \(24, 28\)"),
    ({NET: torch.full((24, 28), torch.nan)}, f"{NET} holds 672 values that are not finite"),
    ({"nn_model.x_embed_nn.0.weight": None}, r"no weight nn_model\.x_embed_nn\.0\.weight; expected the network"),
    ({"nn_model.y_embed_nn.0.weight": torch.zeros(16)}, r"no weight nn_model\.y_embed_nn\.0\.weight; expected"),
    ({"sqrt_beta_t": None}, "sqrt_beta_t is a vector of the timesteps; found none"),
    ({"alphabar_t": torch.zeros(2, 2)}, r"alphabar_t is a vector of the timesteps; found shape \(2, 2\)"),
    ({"alphabar_t": torch.zeros(11)}, "no schedule of DDPM"),
    ({"sqrt_beta_t": torch.full((12,), 0.1)}, "no schedule of DDPM"),
    ({"alphabar_t": torch.full((11,), 0.5).half()}, r"alphabar_t is a torch\.float16 tensor; expected torch\.float32"),
    ({"kmeans": torch.zeros(2)}, "its entry kmeans is none of a Model_Cond_Diffusion's"),
    ({"nn_model.fc1.0.model.1.bias": torch.zeros(24, dtype=torch.int64)}, r"is a torch\.int64 tensor"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_is_no_such_policy_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = bc.save(tmp_path / "bc.pt", "state_mlp", **changes)
    assert_not_read(path, message, names=path)


def test_hostile_files_and_those_of_their_other_models_are_refused(tmp_path: Path) -> None:
    path = bc.save(tmp_path / "bc.pt", "state_mlp", hook=print)
    assert_not_read(path, r"bc\.pt: refused, .*could run code")
    torch.save(bc.weights("image_mlp"), path)
    assert_not_read(path, r"network of Diffusion BC without.*schedule.*Model_Cond_Diffusion")
