"""Going on with the chunk of the call before: what is drawn and executed, and what says that it no longer holds."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import kept_chunk
import numpy as np
import pytest
from click.testing import CliRunner
from doubts import Array, Chance, Check, Forecast, Going
from environments import environment_class
from keeping import Keeping
from kept_times import BLIND, BLIND_BOTH, BOTH, CHECKED, DRAWN, Times
from rollout import Episode
from variants import Variant, open_variant, seeded_noise
from warm_start import add_warm_plans

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.core.spec import ChunkSpec

CALLS, STREAMS, HORIZON = 4, 3, 2


@pytest.fixture
def chunk(four_steps: Path) -> ChunkSpec:
    return load_artifact(four_steps).manifest.spec.chunk


def windows(variant: Variant, call: int) -> dict[str, Array]:
    """Observations of an episode that move a little."""
    (key, spec), given = next(iter(variant.policy.info.observation.items())), np.random.default_rng(0)
    return {key: given.uniform(100, 400, (STREAMS, *spec.shape)).astype(np.float32) + call}


def acted(keeping: Keeping, variant: Variant, calls: int = CALLS) -> list[Array]:
    keeping.reset()
    noise = [seeded_noise(variant.noise, range(STREAMS), call) for call in range(calls)]
    return [np.asarray(keeping.predict_action(windows(variant, i), one)["action"]) for i, one in enumerate(noise)]


def predicted(variant: Variant, call: int) -> Array:
    variant.policy.reset()
    noise = seeded_noise(variant.noise, range(STREAMS), call)
    answer = variant.policy.predict_action(windows(variant, call), noise=noise, plan=variant.plan)
    return np.asarray(answer["action_pred"])


def test_without_a_doubt_every_call_draws(whole: Variant, chunk: ChunkSpec) -> None:
    keeping = Keeping(whole, chunk, HORIZON)
    for call, made in enumerate(acted(keeping, whole)):
        expected = predicted(whole, call)[:, chunk.start : chunk.start + HORIZON]
        np.testing.assert_allclose(made, expected, rtol=1e-4, atol=1e-2)  # of 0..512
    assert np.stack(keeping.batches[0].steps).tolist() == [[4] * STREAMS] * CALLS


def test_a_chunk_is_gone_on_with_until_it_is_used_up(whole: Variant, chunk: ChunkSpec) -> None:
    first = predicted(whole, 0)[:, chunk.start :]
    going = first.shape[1] // HORIZON
    keeping = Keeping(whole, chunk, HORIZON, Chance())
    made = acted(keeping, whole, going + 1)
    np.testing.assert_allclose(np.concatenate(made[:-1], 1), first[:, : going * HORIZON], rtol=1e-4, atol=1e-2)
    expected = predicted(whole, going)[:, chunk.start : chunk.start + HORIZON]
    np.testing.assert_allclose(made[-1], expected, rtol=1e-4, atol=1e-2)
    drawn, checked = (np.stack(getattr(keeping.batches[0], name))[:, 0].tolist() for name in ("drawn", "checked"))
    assert drawn == [True, *[False] * (going - 1), True]
    assert checked == [False, *[True] * (going - 1), False]


def test_a_stream_whose_check_fails_is_drawn_alone(four_steps: Path, whole: Variant, chunk: ChunkSpec) -> None:
    check = Check(four_steps, 2)
    found = Keeping(whole, chunk, HORIZON, check)
    going = acted(found, whole, 2)
    distances = found.batches[0].distances[1]
    between = float(np.sort(distances)[-2:].mean())
    keeping = Keeping(whole, chunk, HORIZON, check, between)
    made = acted(keeping, whole, 2)
    fails = int(distances.argmax())
    assert keeping.batches[0].drawn[1].tolist() == [i == fails for i in range(STREAMS)]
    others = np.arange(STREAMS) != fails
    np.testing.assert_array_equal(made[1][others], going[1][others])
    expected = predicted(whole, 1)[fails, chunk.start : chunk.start + HORIZON]
    np.testing.assert_allclose(made[1][fails], expected, rtol=1e-4, atol=1e-2)


def test_a_check_at_the_last_step_is_a_warm_start_of_one(four_steps: Path, chunk: ChunkSpec, tmp_path: Path) -> None:
    shutil.copytree(four_steps, tmp_path / "warm")
    add_warm_plans(tmp_path / "warm", [1])
    warm = open_variant(f"{tmp_path / 'warm'}:warm-1", "onnxruntime", 1)
    noises = [seeded_noise(warm.noise, range(STREAMS), call) for call in range(2)]
    first, second = (np.asarray(_answer(warm, call, noises[call])) for call in range(2))
    sample, fresh = chunk.normalized(first), noises[1].initial
    executed = chunk.stop - chunk.start
    left = np.full(STREAMS, first.shape[1] - chunk.start - executed)
    going = Going(chunk.moved(sample, executed), fresh, left, fresh[:, 0], fresh[:, 0])
    verdict = Check(four_steps, 3, answered=True).judge(windows(warm, 1), fresh, going)
    assert verdict.clean is not None
    np.testing.assert_allclose(chunk.unnormalized(verdict.clean), second, rtol=1e-4, atol=1e-2)
    counted = np.abs(verdict.clean - going.chunk)[:, chunk.start : chunk.start + left[0]]
    np.testing.assert_allclose(verdict.distances, counted.mean((1, 2)), rtol=1e-5)


def _answer(variant: Variant, call: int, noise: ttscompile.Noise) -> Array:
    answer = variant.policy.predict_action(windows(variant, call), noise=noise, plan=variant.plan)
    return np.asarray(answer["action_pred"])


def test_a_forecast_is_wrong_where_something_else_happened() -> None:
    given = np.random.default_rng(0)
    known, matrix = given.normal(size=(200, 5)).astype(np.float32), given.normal(size=(5, 3)).astype(np.float32)
    following = known @ matrix + 1 + given.normal(0, 0.01, (200, 3)).astype(np.float32)
    forecast = Forecast.fit(known, following)
    seen, done = known[:2, :3], known[:2, 3:]
    going = Going(np.zeros((2, 1, 1), np.float32), np.zeros((2, 1, 1), np.float32), np.ones(2, np.int64), seen, done)
    now = np.stack([following[0], following[1] + [0, 1, 0]]).astype(np.float32)
    distances = forecast.judge({"state": now[:, None]}, going.noise, going).distances
    assert distances[0] < 5 and distances[1] > 50, distances


def episode(actions: list[float], moved_at: int) -> Episode:
    """Of one number an action."""
    array = np.array(actions, np.float32)[:, None]
    return Episode(0, "", {"obs": array}, array, array[:, 0], False, {"moved at": float(moved_at)})


def test_a_reaction_is_the_first_action_that_differs_by_more_than_a_tenth() -> None:
    still = [episode([0, 0, 0, 0, 10], 1), episode([0] * 5, 1), episode([0] * 5, -1)]
    moved = [episode([5, 0, 0.9, 1.1, 10], 1), episode([0] * 4, 1), episode([9] * 5, -1)]
    assert kept_chunk.reactions(moved, still) == pytest.approx((2.5, 2.9))  # 2 and 3; the third was never moved


def test_a_block_is_moved_once_and_only_then_the_score_counts() -> None:
    make = environment_class("pusht:moved")
    moved, still = cast(Any, make()), type("Still", (make,), {"moves": False})()
    for one in (moved, still):
        one.reset(3)
    far = []
    for _ in range(95):
        assert (moved.score > 0) <= (moved.measures["moved at"] >= 0)
        for one in (moved, still):
            one.step(one.rest())
        far.append(float(np.linalg.norm(moved.state[2:4] - still.state[2:4])))
    at = int(moved.measures["moved at"])
    assert at == still.measures["moved at"] and 30 <= at < 95
    assert max(far[: at - 1]) == 0 and min(far[at - 1 :]) > 70


@pytest.mark.slow
def test_ways_are_driven_beside_each_other(four_steps: Path) -> None:
    rules = ["--rules", "check,answered,forecast,chance", "--shares", "0.5", "--horizon", "3", "--every", "3"]
    words = [str(four_steps), f"{four_steps}:full@6", *rules, "--step", "2", "--episodes", "2", "--learned", "2"]
    words += ["--warm", "1", "--calls", "4"]
    asked = [*words, "--environment", "pusht:moved", "--json"]
    result = CliRunner().invoke(kept_chunk.main, asked, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    rows = {row["evaluation"]["label"].removeprefix(f"{four_steps}:"): row for row in json.loads(result.stdout)}
    ruled = ["check, 0.5", "answered, 0.5", "forecast, 0.5", "chance, 0"]
    assert list(rows) == ["every 3 actions", "full@6", "warm, 1", *ruled]
    assert rows["every 3 actions"]["steps"] == pytest.approx(4 / 3, rel=0.02)
    assert rows["full@6"]["steps"] == pytest.approx(4 / 6, rel=0.02)
    assert rows["warm, 1"]["steps"] == pytest.approx(1 / 3, rel=0.1)  # the first call has no chunk
    assert rows["check, 0.5"]["checks"] > 0 == rows["forecast, 0.5"]["checks"] == rows["chance, 0"]["anew"]
    assert rows["chance, 0"]["steps"] < rows["check, 0.5"]["steps"] < rows["every 3 actions"]["steps"]
    times = rows["every 3 actions"]["times"]
    assert list(times) == ["drawn", "checked", "both"] and times["checked"] < times["drawn"] < times["both"]
    assert rows["every 3 actions"]["ms"] == pytest.approx(times["drawn"] / 3, rel=0.02)
    assert rows["chance, 0"]["ms"] / rows["every 3 actions"]["ms"] == pytest.approx(
        rows["chance, 0"]["steps"] / rows["every 3 actions"]["steps"]
    )
    assert all(row["still"] is not None and len(row["reaction"]) == 2 for row in rows.values())


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--rules", "checks"], "'checks' is no rule; expected some of check"),
        (["--shares", "2"], "2 is no share of 0 to 1"),
        (["--every", "0"], "0 is below 1"),
        (["--chances", "x"], "could not convert string to float"),
    ],
)
def test_words_that_mean_nothing_are_refused(words: list[str], told: str, four_steps: Path) -> None:
    result = CliRunner().invoke(kept_chunk.main, [str(four_steps), *words])
    assert (result.exit_code, told in result.output) == (2, True), result.output


@pytest.mark.parametrize("step", [0, 4])
def test_a_check_needs_a_step_with_noise_and_action(step: int, four_steps: Path) -> None:
    with pytest.raises(ttscompile.errors.TtscompileError, match=f"no level of noise before a step {step}"):
        Check(four_steps, step)


def test_calls_take_what_they_are_made_of(four_steps: Path) -> None:
    kinds = {DRAWN: 8.0, CHECKED: 3.0, BOTH: 10.0, BLIND: 2.0, BLIND_BOTH: 9.0}
    drawn, checked = np.array([True, True, False]), np.array([False, True, True])
    check = Check(four_steps, 2)
    assert Times.by(kinds, check).of(drawn, checked).tolist() == [8, 10, 3]
    check.blind = True
    assert Times.by(kinds, check).of(drawn, checked).tolist() == [8, 9, 2]
    assert Times.by(kinds, Chance()).of(drawn, checked).tolist() == [8, 8, 0]


def test_without_pictures_no_check_is_blind(four_steps: Path) -> None:
    with pytest.raises(ttscompile.errors.TtscompileError, match="sees no pictures"):
        Check(four_steps, 2, blind=True)


def test_the_pictures_are_those_that_the_chunk_of_a_stream_was_drawn_with(whole: Variant, chunk: ChunkSpec) -> None:
    keeping = Keeping(whole, chunk, HORIZON, Chance())
    keeping.reset()
    told = {"camera": SimpleNamespace(image=True), "state": SimpleNamespace(image=False)}
    keeping.info = cast(Any, SimpleNamespace(observation=told))
    first, second = ({"camera": np.full((2, 1, 1), n), "state": np.full((2, 1), n)} for n in (1, 2))
    before = keeping._pictures(first, np.ones(2, np.bool_))
    nothing = np.zeros(1, np.float32)
    keeping._going = Going(nothing, nothing, np.zeros(1, np.int64), nothing, nothing, before)
    after = keeping._pictures(second, np.array([False, True]))
    assert list(after) == ["camera"] and after["camera"].ravel().tolist() == [1, 2]
