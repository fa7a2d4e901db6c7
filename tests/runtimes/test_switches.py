"""A number of the actions that has two values alone, as a gripper's may, however a call is made."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.lower.whole_call import every_way, inputs, make
from ttscompile import ChunkSpec
from ttscompile.artifact import load_artifact
from ttscompile.core.spec import Affine, Switch
from ttscompile.errors import ObservationError, SpecError

from .toys import toy_program

SWITCH = Switch(channel=1, threshold=0.125, below=3.0, above=-2.0)


@pytest.mark.slow
def test_every_way_to_make_a_call_decides_alike_and_takes_no_prefix(tmp_path: Path) -> None:
    program = toy_program(steps=3, blocks=2, noise=0.0, pruner=False)
    chunk = replace(program.spec.chunk, switches=(SWITCH,))
    program = replace(program, spec=replace(program.spec, chunk=chunk))
    policy, model = make(program, tmp_path)
    assert chunk.normalizer is not None
    obs, noise = inputs(policy, np.random.default_rng(0), 3)
    plain = replace(chunk, switches=())
    reference = ttscompile.load(tmp_path / "artifact", "reference")
    sample, _ = reference._runtime.predict(
        {"obs": program.spec.observations["obs"].normalized(obs["obs"])}, noise, reference.plans["dense"]
    )
    expected = plain.unnormalized(sample)
    expected[..., 1] = np.where(sample[..., 1] >= 0.125, -2, 3)
    assert set(np.unique(expected[..., 1])) == {-2, 3}
    for name, found in every_way(tmp_path / "artifact", model, obs, noise).items():
        np.testing.assert_array_equal(found[..., 1], expected[..., 1], name)
        np.testing.assert_allclose(found[..., 0], expected[..., 0], rtol=0, atol=1e-4, err_msg=name)
    assert load_artifact(tmp_path / "artifact").manifest.spec.chunk.switches == (SWITCH,)
    # Its actions do not say what they were denoised as.
    with pytest.raises(ObservationError, match="takes no prefix: .*two values alone"):
        policy.predict_action(obs, noise, prefix=np.zeros((3, 1, 2), np.float32))


def test_the_range_of_such_a_number_is_that_of_its_values() -> None:
    chunk = ChunkSpec(2, 0, 1, Affine(np.array([0.5, 4.0]), np.array([1.0, -1.0])), switches=(SWITCH,))
    assert chunk.usual is not None
    np.testing.assert_allclose(chunk.usual.unnormalize(np.array([[-1, -1], [1, 1]], np.float32)), [[-4, -2], [0, 3]])
    alike = replace(chunk, switches=(replace(SWITCH, above=3.0),))
    assert alike.usual is not None
    np.testing.assert_allclose(alike.usual.unnormalize(np.array([[-1, -1], [1, 1]], np.float32))[:, 1], [2, 4])
    assert replace(chunk, ranged=False).usual is None
    assert replace(chunk, normalizer=None).usual is None


@pytest.mark.parametrize(
    ("switches", "message"),
    [
        ((SWITCH, SWITCH), r"switches are of the channels \[1, 1\]; expected different ones below 2"),
        ((replace(SWITCH, channel=2),), r"switches are of the channels \[2\]; expected different ones below 2"),
    ],
)
def test_a_channel_has_one(switches: tuple[Switch, ...], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        ChunkSpec(2, 0, 1, switches=switches)


@pytest.mark.parametrize("changes", [{"threshold": float("nan")}, {"above": float("inf")}])
def test_its_numbers_are_finite(changes: dict[str, float]) -> None:
    with pytest.raises(SpecError, match="a switch's threshold and values must be finite"):
        replace(SWITCH, **changes)  # type: ignore[arg-type]
