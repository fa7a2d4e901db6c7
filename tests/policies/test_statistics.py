"""Statistics of a normaliser that no data have: constant, inverted, infinite, out of all proportion."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.artifact.tiny import write_tiny
from tests.hostile.forged import forge
from ttscompile.artifact import load_artifact
from ttscompile.errors import ArtifactError, SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.policies.lerobot.processors import Normalizer, Statistics

from .lerobot_tiny import save_policy
from .refused import assert_not_read

Payload = dict[str, Any]
OBS, ACTION = "normalizer.params_dict.obs", "normalizer.params_dict.action"


@pytest.mark.parametrize("key", [f"{OBS}.scale", f"{OBS}.offset", f"{ACTION}.scale", f"{ACTION}.offset"])
@pytest.mark.parametrize("value", [float("inf"), -float("inf"), float("nan")])
def test_of_diffusion_policy_they_are_finite(
    key: str, value: float, payload: Callable[..., Payload], save: Callable[[Payload], Path]
) -> None:
    built = payload()
    built["state_dicts"]["ema_model"][key][1] = value
    assert_not_read(save(built), f"{key} is .*; expected finite numbers, and no zero in a scale")


def test_an_inverted_scale_is_the_original_s(payload: Callable[..., Payload], save: Callable[[Payload], Path]) -> None:
    """Of a largest number below the smallest: what the policy was trained with, so it is computed as it is."""
    built = payload()
    for key in (OBS, ACTION):
        built["state_dicts"]["ema_model"][f"{key}.scale"] *= -1
    _, spec = load_checkpoint_policy(save(built))
    saved = built["state_dicts"]["ema_model"]
    x = torch.randn(4, len(saved[f"{OBS}.scale"]))
    normalizer = spec.observations["obs"].normalizer
    assert normalizer is not None and spec.chunk.normalizer is not None
    np.testing.assert_array_equal(
        normalizer.normalize(x.numpy()), (x * saved[f"{OBS}.scale"] + saved[f"{OBS}.offset"]).numpy()
    )
    actions = torch.randn(4, len(saved[f"{ACTION}.scale"]))
    expected = (actions - saved[f"{ACTION}.offset"]) / saved[f"{ACTION}.scale"]
    np.testing.assert_array_equal(spec.chunk.normalizer.unnormalize(actions.numpy()), expected.numpy())
    assert normalizer.reach > 0


def changed(folder: Path, name: str, values: float) -> Path:
    """A policy of LeRobot with another statistic in its first entry, in both pipelines."""
    directory = save_policy(folder, modes=("MEAN_STD", "MEAN_STD", "MEAN_STD"))
    for file in ("before.safetensors", "after.safetensors"):
        tensors = load_file(directory / file)
        tensors[name].view(-1)[0] = values
        save_file(tensors, directory / file)
    return directory


@pytest.mark.parametrize("name", ["observation.state", "action"])
@pytest.mark.parametrize(
    ("statistic", "value", "why"),
    [
        ("std", -0.5, "has a deviation below 0"),
        ("std", -1e-8, "has a deviation below 0"),
        ("std", float("inf"), "holds values that are not finite"),
        ("mean", float("nan"), "holds values that are not finite"),
    ],
)
def test_of_lerobot_a_deviation_is_finite_and_not_below_zero(
    name: str, statistic: str, value: float, why: str, tmp_path: Path
) -> None:
    """Before, an action's deviation below 0 counted as one of nearly 0: other actions than the original's."""
    assert_not_read(changed(tmp_path, f"{name}.{statistic}", value), rf"{name}\.{statistic} {why}", format="lerobot")


@pytest.mark.parametrize("mode", ["MIN_MAX", "QUANTILES", "QUANTILE10"])
def test_of_lerobot_inverted_ranges_are_the_original_s(mode: str) -> None:
    """As lerobot computes them, there and back."""
    low, high, x = torch.tensor([3.0, 2.0]), torch.tensor([1.0, -2.0]), torch.randn(7, 2)
    statistics = Statistics(mode, low, high, 1e-8)
    assert torch.equal(Normalizer(statistics)(x), 2 * (x - low) / (high - low) - 1)
    back = statistics.inverse().unnormalize(Normalizer(statistics)(x).numpy())
    np.testing.assert_allclose(back, x.numpy(), rtol=0, atol=1e-5)
    assert statistics.usual_range == ((1.0, -2.0), (3.0, 2.0))


def test_a_range_out_of_all_proportion_is_refused() -> None:
    """The difference is infinite, or its inverse is."""
    for low, high in ((-3e38, 3e38), (0.0, 1e-45)):
        with np.errstate(over="ignore"), pytest.raises(SpecError, match="normaliser scale"):
            Statistics("MIN_MAX", torch.tensor([low]), torch.tensor([high]), 1e-8).inverse()


@pytest.mark.parametrize("value", [0, 1e39, -1e400, "1", None, True])
def test_of_an_artifact_they_are_finite_and_not_zero(value: object, tmp_path: Path) -> None:
    write_tiny(tmp_path / "compiled")

    def change(document: dict[str, Any]) -> None:
        document["spec"]["chunk"]["normalizer"]["scale"][0] = value

    forge(tmp_path / "compiled", change)
    with pytest.raises(ArtifactError, match=r"normali[sz]er|number|Infinity"):
        load_artifact(tmp_path / "compiled")
