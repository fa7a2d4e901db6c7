"""Actions that are relative to numbers that the robot measures; ``test_relative_poses`` has them beside poses."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.artifact.tiny import tiny_spec
from tests.calibration import policies
from tests.lower.whole_call import every_way, inputs, make
from tests.once import Once
from ttscompile import ChunkSpec, Noise, ObservationSpec, PolicySpec
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.strict_json import dump, parse
from ttscompile.artifact.typed_json import from_json, to_json
from ttscompile.core.spec import Affine, Relative, Switch
from ttscompile.errors import ArtifactError, SpecError
from ttscompile.report import facts
from ttscompile.samplers.flow import flow_matching_table

from .toys import toy_program

RELATIVE = Relative("obs", (1, None))
ROWS = np.arange(1, 4, dtype=np.float32)[:, None]


def with_rows(chunk: ChunkSpec) -> ChunkSpec:
    """The same chunk of three steps with a normaliser of its own for each."""
    own = chunk.normalizer
    assert own is not None
    return replace(chunk, normalizer=Affine(own.scale * ROWS, own.offset + ROWS))


@pytest.mark.slow
@pytest.mark.parametrize("rows", [False, True])
def test_every_way_to_make_a_call_adds_it(tmp_path: Path, rows: bool) -> None:
    """To each stream of a batch its own."""
    program = toy_program(steps=3, blocks=2, noise=0.0, pruner=False)
    plain = with_rows(program.spec.chunk) if rows else program.spec.chunk
    program = replace(program, spec=replace(program.spec, chunk=replace(plain, relative=RELATIVE)))
    policy, model = make(program, tmp_path)
    obs, noise = inputs(policy, np.random.default_rng(0), 3)
    reference = ttscompile.load(tmp_path / "artifact", "reference")
    given = {"obs": program.spec.observations["obs"].normalized(obs["obs"])}
    sample, _ = reference._runtime.predict(given, noise, reference.plans["dense"])
    assert plain.normalizer is not None
    expected = (sample - plain.normalizer.offset) / plain.normalizer.scale
    expected[..., 0] += obs["obs"][:, None, 1]
    for name, found in every_way(tmp_path / "artifact", model, obs, noise).items():
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5, err_msg=name)
    written = load_artifact(tmp_path / "artifact")
    assert written.manifest.spec.chunk.relative == RELATIVE
    told = {row[0]: row[1] for row in facts.policy(written).tables[0].rows}["action"]
    assert told == "2 numbers, 3 steps predicted, 1..2 executed; 1 of the numbers are relative to 'obs'"


def compiled(once: Once, relative: Relative | None) -> Path:
    """A policy of flow matching."""
    table, own = replace(flow_matching_table(6), timesteps=np.arange(6)[::-1].copy()), policies.spec()
    spec = replace(own, sampler=table, chunk=replace(own.chunk, relative=relative))
    name, network = f"flow, relative: {relative is not None}", policies.Mixer(0).eval()
    return once.compiled(name, lambda to: ttscompile.compile_denoiser(network, spec, to))[0]


@pytest.mark.parametrize("rows", [False, True])
def test_a_chunk_that_is_moved_holds_the_same_actions(rows: bool) -> None:
    program = toy_program(pruner=False)
    chunk = replace(with_rows(program.spec.chunk) if rows else program.spec.chunk, relative=RELATIVE)
    rng = np.random.default_rng(1)
    sample = rng.standard_normal((2, 3, 2)).astype(np.float32)
    old, new = (chunk.reference({"obs": rng.standard_normal((2, 2)).astype(np.float32)}) for _ in range(2))
    assert old is not None and new is not None
    moved = chunk.moved(sample, 1, (old, new))
    before, after = chunk.unnormalized(sample, old), chunk.unnormalized(moved, new)
    np.testing.assert_allclose(after, before[:, [1, 2, 2]], rtol=0, atol=1e-5)
    absolute = replace(chunk, relative=None)
    np.testing.assert_allclose(
        absolute.unnormalized(absolute.moved(sample, 1)), absolute.unnormalized(sample)[:, [1, 2, 2]], atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_a_prefix_is_of_actions(once: Once, runtime: str) -> None:
    """It is as one of the difference in the policy that has the same network and adds nothing."""
    rng, added = np.random.default_rng(3), np.zeros((2, 1, 2), np.float32)
    obs = {"obs": 3 * rng.standard_normal((2, 2, 3)).astype(np.float32)}
    noise = Noise(rng.standard_normal((2, policies.HORIZON, policies.CHANNELS)).astype(np.float32))
    added[:, 0, 0] = obs["obs"][:, -1, 2]
    prefix = rng.standard_normal((2, 2, 2)).astype(np.float32)
    found, expected = (
        ttscompile.load(compiled(once, relative), runtime).predict_action(obs, noise, "dense", given)["action_pred"]
        for relative, given in ((Relative("obs", (2, None)), prefix), (None, prefix - added))
    )
    np.testing.assert_allclose(found, expected + added, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found[:, 1:3], prefix, rtol=0, atol=1e-5)


def test_it_is_written_where_there_is_some_and_read_strictly() -> None:
    """What does not know the word refuses it, like any other that it does not know."""
    plain = tiny_spec()
    assert "relative" not in to_json(plain)["chunk"]
    key, channels = next(iter(plain.observations)), plain.chunk.action_dim
    numbers = np.arange(plain.sample[0] * channels, dtype=np.float32).reshape(-1, channels)
    rows = Affine(np.ones_like(numbers), numbers)
    relative = Relative(key, (0, *[None] * (channels - 1)))
    spec = replace(plain, chunk=replace(plain.chunk, normalizer=rows, relative=relative))
    written = to_json(spec)
    found = from_json(PolicySpec, parse(dump(written), "spec"))
    assert found.chunk.relative == relative
    assert found.chunk.normalizer is not None
    np.testing.assert_array_equal(found.chunk.normalizer.offset, rows.offset)
    written["chunk"]["later"] = written["chunk"].pop("relative")
    with pytest.raises(ArtifactError, match="later"):
        from_json(PolicySpec, parse(dump(written), "spec"))


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda: Relative("obs", (1,)), r"relative has \(1,\); expected 2 entries"),
        (lambda: Relative("obs", (1, -1)), "an entry of relative"),
        (lambda: Relative("obs", (None, 1)), r"relative has \(None, 1\); .* None for \[1\]"),
        (lambda: Relative("obs", (2, None)), r"'obs': expected float32 \[N\] with N of 3 at least; found float32"),
        (lambda: Relative("other", (0, None)), r"relative to 'other', which is none of \['obs'\]"),
    ],
)
def test_what_nothing_can_be_relative_to(made: Callable[[], Relative], message: str) -> None:
    spec = toy_program(pruner=False).spec
    chunk = replace(spec.chunk, switches=(Switch(1, 0.0, 0.0, 1.0),))
    with pytest.raises(SpecError, match=message):
        replace(spec, chunk=replace(chunk, relative=made()))


def test_what_has_no_numbers_to_add() -> None:
    spec = toy_program(pruner=False).spec
    chunk = replace(spec.chunk, relative=RELATIVE)
    for one in (ObservationSpec((2,), dtype="int64", bounds=(0, 3)), ObservationSpec((2, 2), window=False)):
        with pytest.raises(SpecError, match="actions are relative to observation 'obs'"):
            replace(spec, observations={"obs": one}, chunk=chunk)
    replace(spec, observations={"obs": ObservationSpec((4, 2))}, chunk=chunk)
    two = np.ones((2, 2), np.float32)
    with pytest.raises(
        SpecError, match=r"normaliser: expected \[2\], or a row for each of 3 steps; found shape \[2, 2\]"
    ):
        replace(spec, chunk=replace(chunk, normalizer=Affine(two, two)))


def test_no_range_is_known_of_actions_whose_place_is_not() -> None:
    chunk = replace(toy_program(pruner=False).spec.chunk, ranged=True)
    assert chunk.usual is not None
    assert replace(chunk, relative=RELATIVE).usual is None
    np.testing.assert_array_equal(with_rows(chunk).scale, chunk.scale * ROWS[1:])
