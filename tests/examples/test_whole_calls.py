"""Rules about whole calls: what they leave out, and that without a threshold they are the original."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import falcon as falcons
import numpy as np
import pytest
import torch
import whole_calls
from click.testing import CliRunner
from variants import Variant, seeded_noise

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.plan import DENSE
from ttscompile.runtimes.random_calls import normalized, random_calls
from ttscompile.runtimes.reference.model import ReferenceModel

CALLS, STREAMS = 4, 3


def answers(policy: falcons.Falcon | whole_calls.Light, variant: Variant) -> list[whole_calls.Array]:
    """Calls of an episode whose observations move a little."""
    policy.reset()
    (key, spec), given = next(iter(variant.policy.info.observation.items())), np.random.default_rng(0)
    first = given.uniform(100, 400, (STREAMS, *spec.shape)).astype(np.float32)
    noise = [seeded_noise(variant.noise, range(STREAMS), call) for call in range(CALLS)]
    return [np.asarray(policy.predict_action({key: first + i}, noise=one)["action"]) for i, one in enumerate(noise)]


def test_what_is_on_a_line_stays_on_it() -> None:
    past = np.stack([np.arange(8.0), 5 - 2 * np.arange(8.0)], 1).astype(np.float32)
    np.testing.assert_allclose(whole_calls.extrapolated(past, 2), [[8, -11], [9, -13]], atol=0.05)


def test_without_a_threshold_falcon_is_the_original(four_steps: Path, whole: Variant) -> None:
    falcon = falcons.Falcon(four_steps, "full", 0.0)
    light = whole_calls.Light(whole, 4, np.inf, displacements=False)  # nothing is that fast
    for mine, own in zip(answers(falcon, whole), answers(light, whole), strict=True):
        np.testing.assert_allclose(mine, own, rtol=1e-4, atol=1e-2)  # of 0..512
    assert (falcon.count.steps, falcon.count.checks) == (4 * CALLS * STREAMS, 3 * (CALLS - 1) * STREAMS)
    assert light.count == falcons.Count(CALLS * STREAMS, 4 * CALLS * STREAMS)


def test_looking_at_once_or_one_after_the_other_begins_at_the_same_steps(four_steps: Path, whole: Variant) -> None:
    one, many = (falcons.Falcon(four_steps, "full", 0.3, together=together) for together in (False, True))
    for mine, other in zip(answers(one, whole), answers(many, whole), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-4, atol=1e-2)
    assert (one.count.steps, one.count.checks) == (many.count.steps, many.count.checks)
    assert 4 * STREAMS < one.count.steps < 4 * CALLS * STREAMS  # some begin late
    assert min(one.count.looking, many.count.looking) > 0


def test_a_chunk_that_is_near_enough_is_begun_with(
    four_steps: Path, whole: Variant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(falcons, "EXPLORED", 0.0)
    falcon = falcons.Falcon(four_steps, "full", np.inf)
    answers(falcon, whole)
    assert falcon.count.steps == (4 + CALLS - 1) * STREAMS  # the last step alone, but for the first call


@pytest.mark.parametrize("made", ["four_steps", "toy_compiled"])  # the second has what a step makes of both
def test_several_steps_are_evaluated_at_once_as_one_after_the_other(made: str, request: pytest.FixtureRequest) -> None:
    artifact = load_artifact(request.getfixturevalue(made))
    view = view_of(artifact, artifact.plan(DENSE))
    spec, model = view.manifest.spec, ReferenceModel.from_view(view)
    assert (view.pieces.step is not None) == (made == "toy_compiled")
    calls = [normalized(spec, obs) for obs, _ in random_calls(spec, STREAMS, 0)]
    obs = {key: torch.from_numpy(np.concatenate([call[key] for call in calls])) for key in calls[0]}
    steps, draw = [1, 3, 2, 3], torch.Generator().manual_seed(0)
    samples = [torch.randn(STREAMS, *spec.sample, generator=draw) for _ in steps]
    with torch.no_grad():
        contexts = model.prologue(obs)
        found = falcons.ManySteps(view).outputs(samples, steps, contexts)

        def blocks(k: int, hidden: torch.Tensor) -> torch.Tensor:
            for b in range(model.blocks):
                hidden = hidden + model.block(b, k, hidden, contexts)
            return hidden

        for sample, k, mine in zip(samples, steps, found, strict=True):
            torch.testing.assert_close(mine, model.predict(sample, k, contexts, blocks), rtol=1e-4, atol=1e-5)
        assert (found[1] - found[3]).abs().max() > 1e-3  # of the same step, and other samples


def test_every_other_call_is_left_out_where_all_are_fast(whole: Variant) -> None:
    light = whole_calls.Light(whole, 4, -1.0, displacements=False)
    made = answers(light, whole)
    assert light.count == falcons.Count(CALLS * STREAMS, 2 * 4 * STREAMS)
    expected = whole_calls.extrapolated(made[0][1][-whole_calls.MEMORY :], made[0].shape[1])
    np.testing.assert_array_equal(made[1][1], expected)


class Seen:
    """A policy that notes the number that its pictures and its state show."""

    def __init__(self) -> None:
        shown = {"camera": SimpleNamespace(image=True), "state": SimpleNamespace(image=False)}
        self.info, self.calls = SimpleNamespace(observation=shown), list[tuple[int, int]]()

    def reset(self) -> None:
        """A new episode."""

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: object = None, plan: object = None
    ) -> Mapping[str, Any]:
        self.calls.append((int(obs_dict["camera"][0]), int(obs_dict["state"][0])))
        return {}


def test_pictures_are_kept_between_two_looks_and_the_state_is_new(whole: Variant) -> None:
    seen: Any = Seen()
    kept = whole_calls.Kept(replace(whole, policy=seen), 4, 2)
    for _ in range(2):
        kept.reset()
        for number in range(3):
            kept.predict_action({"camera": np.array([number]), "state": np.array([number])})
    assert seen.calls == [(0, 0), (0, 1), (2, 2)] * 2
    assert kept.count == falcons.Count(6, 24)


@pytest.mark.slow
def test_they_drive_beside_plans(four_steps: Path) -> None:
    words = [str(four_steps), "--falcon", "0,9:2", "--light", "1", "--episodes", "2", "--json"]
    result = CliRunner().invoke(whole_calls.main, words, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    rows = {row["label"].removeprefix(f"{four_steps}:"): row for row in json.loads(result.stdout)}
    assert list(rows) == ["full", "Falcon, 0:1", "Falcon, 9:2", "SP-VLA, 1"]
    assert rows["Falcon, 0:1"]["looking_ms"] > rows["full"]["looking_ms"] == 0
    assert rows["Falcon, 0:1"]["steps"] == rows["full"]["steps"] == 4
    assert 2 <= rows["Falcon, 9:2"]["steps"] < 3
    assert rows["SP-VLA, 1"]["steps"] < 4
    assert rows["Falcon, 0:1"]["score"] == pytest.approx(rows["full"]["score"], abs=1e-3)


def test_a_loop_that_draws_noise_is_refused(compiled_layer: Path) -> None:
    with pytest.raises(ttscompile.errors.TtscompileError, match="--sampler ddim"):
        falcons.Falcon(compiled_layer, "dense", 0.1)


@pytest.mark.parametrize("words", [["--falcon", "0.1:0"], ["--falcon", "x"], ["--look", "0"], ["--look", "0.5"]])
def test_rules_that_mean_nothing_are_refused(words: list[str]) -> None:
    assert CliRunner().invoke(whole_calls.main, ["DIR", *words]).exit_code == 2


def test_more_steps_than_the_loop_has_cannot_be_left(four_steps: Path) -> None:
    with pytest.raises(ttscompile.errors.TtscompileError, match="has 4 steps; 5 cannot"):
        falcons.Falcon(four_steps, "full", 0.1, 5)
