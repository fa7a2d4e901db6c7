"""The one yardstick: what it says of answers that are known, and of plans that cannot share the original's noise."""

from dataclasses import replace
from math import erf
from pathlib import Path

import numpy as np
import pytest

import ttscompile
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.calibration.arguments import CallLimits
from ttscompile.calibration.calls import load_episodes
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.judge import Score, _Answers, further, judge, timed
from ttscompile.calibration.kept import holding
from ttscompile.calibration.proposer import Proposal
from ttscompile.calibration.state import StateFile
from ttscompile.calibration.trials import (
    CONFIRMING,
    DRAWS,
    FEWEST_OBSERVATIONS,
    HELD_OUT,
    LEARNED,
    MOST_DRAWS,
    QUICKLY,
    STRETCH,
    Trials,
    _seconds,
)
from ttscompile.core.lattice import dense_plan, uniform_plan, whole_steps_plan
from ttscompile.core.plan import Plan
from ttscompile.errors import CalibrationError
from ttscompile.measure.points import Gaps, pairs, rooted
from ttscompile.samplers.flow import flow_matching_table

from . import policies
from .tasks import distance, trials_of


@pytest.fixture
def trials(compiled: Path, recording: Path, tmp_path: Path) -> Trials:
    return trials_of(compiled, recording, tmp_path)


def test_by_hand() -> None:
    """Two draws of one call with one number each: |x0 - y1| + |x1 - y0| - |x0 - x1| - |y0 - y1|."""
    x, y = np.array([[[0.0], [5.0]]]), np.array([[[1.0], [3.0]]])
    h, apart = pairs(x, y)
    assert (h.tolist(), apart.tolist()) == ([3 + 4 - 5 - 2], [2.0])
    x, y = np.array([[[3.0, 4.0], [0.0, 0.0]]]), np.array([[[0.0, 0.0], [1.0, 1.0]]])
    root, crossed = (25 / 2) ** 0.5, (13 / 2) ** 0.5  # of the mean square of two numbers
    assert pairs(x, y)[0].tolist() == [pytest.approx(crossed + 0 - root - 1)]


@pytest.mark.parametrize("paired", [True, False])
def test_it_is_the_energy_distance_whether_or_not_noise_is_shared(paired: bool) -> None:
    """Of two normal distributions a shift apart: 2 E|N(s, 2)| - 2 E|N(0, 2)|, over E|N(0, 2)|."""
    draw, shift = np.random.default_rng(0), 1.5
    y = draw.standard_normal((20000, 2, 1))
    x = shift + (y if paired else draw.standard_normal(y.shape))
    apart = 2 / np.pi**0.5
    moved = apart * np.exp(-(shift**2) / 4) + shift * erf(shift / 2)
    assert distance(x, y) == pytest.approx(((2 * moved - 2 * apart) / apart) ** 0.5, rel=0.02)


def test_the_same_distribution_is_at_no_distance_and_another_spread_is_not() -> None:
    draw = np.random.default_rng(1)
    y, other = draw.standard_normal((2, 40000, 2, 3))
    assert abs(distance(other, y)) < 0.05
    assert distance(0.3 * other, y) > 0.3
    assert distance(np.zeros_like(y), y) > 0.5  # one answer for all noise


def test_shared_noise_makes_it_precise_and_the_root_grows_as_the_error_does() -> None:
    draw = np.random.default_rng(2)
    y, other = draw.standard_normal((2, 4000, 2, 16))
    small, large, alone = (distance(x, y) for x in (y + 0.05, y + 0.1, other + 0.05))
    assert large == pytest.approx(2 * small, rel=0.02)
    spread = {name: pairs(x, y)[0].std() for name, x in (("shared", y + 0.05), ("own", other + 0.05))}
    assert spread["shared"] < 0.01 * spread["own"]
    assert abs(alone - small) < 0.1


def test_dense_is_the_original_and_fewer_steps_are_further(trials: Trials) -> None:
    dense = judge(trials, trials.artifact.plans["dense"])
    assert dense.distance == pytest.approx(0.0, abs=1e-3)
    assert dense.error == pytest.approx(0.0, abs=1e-6)
    assert (dense.sparsity, dense.plans, dense.tokens) == (0.0, 1, 1.0)
    two, five = (judge(trials, Plan(cells=whole_steps_plan(10, 6, steps))) for steps in ((0, 9), (0, 6, 7, 8, 9)))
    assert (two.sparsity, five.sparsity) == (0.8, 0.5)
    assert 0.01 < five.distance < 0.9 * two.distance
    assert five.interval[0] < five.distance < five.interval[1]
    assert two.flops_saved > five.flops_saved > 0.4
    again = Plan(cells=whole_steps_plan(10, 6, (0, 9)))
    assert two == judge(trials, again), "the same noise, whatever was judged before"
    assert timed([(trials, again)], 1)[0].median > 0
    assert judge(trials, again, LEARNED) != two


def test_a_single_held_out_episode_is_not_certain(compiled: Path, recording: Path, tmp_path: Path) -> None:
    artifact = load_artifact(compiled)
    episodes = load_episodes(artifact.manifest.spec, [recording], None)[:3]
    few = Trials.of(artifact, episodes, StateFile(tmp_path, {}))
    assert len(few.split.validation) == 1
    score = judge(few, Plan(cells=whole_steps_plan(10, 6, (0, 9))))
    assert 0 < score.interval[0] < score.distance < score.interval[1]


def test_errors_are_of_calls_with_the_same_noise(trials: Trials, compiled: Path) -> None:
    """Call by call through the public interface."""
    plan, policy, sample = Plan(cells=uniform_plan(10, 6, 5)), ttscompile.load(compiled), trials.held_out
    errors = []
    for stretch, row in sample.calls.tolist():
        episode = trials.episodes[sample.stretches[stretch, 0]]
        obs = {key: array[row : row + 1] for key, array in episode.observations.items()}
        for draw in range(DRAWS):
            noise = trials.noise(trials.artifact.manifest.spec, [trials.noise_key(HELD_OUT, stretch, row, draw)])
            made = []
            for each in (plan, "dense"):
                policy.reset()
                made.append(policy.predict_action(obs, noise=noise, plan=each)["action"])
            errors.append(np.abs(made[0] - made[1]).mean())
    score = judge(trials, plan)
    assert score.error == pytest.approx(np.mean(errors), rel=1e-3)
    assert score.error_p90 == pytest.approx(np.quantile(errors, 0.9), rel=1e-3)


def test_a_plan_that_reads_earlier_calls_makes_them_all_in_order(trials: Trials) -> None:
    """All cells of step 1 of the call before: the answers differ from those of calls of their own."""
    cells = dense_plan(10, 6)
    cells[1:] = 2
    reading = cells.copy()
    reading[1] = 3
    alternating = [judge(trials, Plan(cells=one)) for one in (cells, reading)]
    # A schedule never reads what it never computes: repaired, the two are one plan.
    assert alternating[0].distance == pytest.approx(alternating[1].distance, rel=1e-4)
    assert alternating[1].plans == 1


def score(*h: float) -> Score:
    """Of calls that are an episode each."""
    gaps = Gaps(np.array(h), np.arange(len(h)))
    return Score(rooted(gaps.mean, 1.0), (0, 0), None, None, 0, 0, 0, 1, gaps=gaps)


def test_limits_of_a_difference() -> None:
    near, far = score(0.04, 0.04, 0.04), score(0.09, 0.09, 0.09)
    assert further(far, near) == pytest.approx((0.1, 0.1))
    assert further(near, far) == pytest.approx((-0.1, -0.1))
    mixed = score(0.01, 0.04, 0.25)
    difference, limit = further(mixed, near)
    assert difference == pytest.approx(0.1**0.5 - 0.2)
    assert limit > difference
    assert further(score(0.09), score(0.04))[1] > 100, "one call tells nothing"
    below = score(-0.01, -0.01, -0.01)
    assert further(score(0.0025, 0.0025, 0.0025), below) == pytest.approx((0.15, 0.05)), "no distance is below 0"


@pytest.mark.parametrize(
    ("episodes", "calls", "share"),
    [(4, 4, 0.0), (2, 8, 0.0), (16, 1, 0.0), (4, 4, 0.5), (8, 4, 0.5), (4, 1, 0.0), (4, 8, 0.3)],
)
def test_ninety_five_of_a_hundred_limits_hold(episodes: int, calls: int, share: float) -> None:
    """Whether calls differ, or episodes: the latter have this share of the variance. Of a bootstrap of four 81 do."""
    rng, numbers = np.random.default_rng(0), np.repeat(np.arange(episodes), calls)
    held = []
    for _ in range(2000):
        apart = share**0.5 * rng.standard_normal(episodes)[numbers]
        gaps = Gaps(1 + apart + (1 - share) ** 0.5 * rng.standard_normal(len(numbers)), numbers)
        low, high = np.quantile(gaps.resampled(gaps.clustered), (0.025, 0.975))
        held.append(low <= 1 <= high)
    assert 0.925 < np.mean(held) < 0.98


def test_episodes_of_other_lengths_count_alike() -> None:
    gaps = Gaps(np.array([1.0, 2.0, 3.0, 8.0]), np.array([0, 0, 0, 1]))
    assert gaps.mean == 5.0
    for clustered in (False, True):
        assert np.mean(gaps.resampled(clustered)) == pytest.approx(5.0, abs=2.0)


def test_one_split_and_every_answered_call_has_one_before_it(trials: Trials) -> None:
    parts = ((LEARNED, trials.split.calibration), *((one, trials.split.validation) for one in (HELD_OUT, CONFIRMING)))
    for part, numbers in parts:
        sample = trials.sample(part)
        assert set(sample.episodes) <= set(numbers)
        assert sample.answers.shape == (len(sample.calls), DRAWS, policies.HORIZON, policies.CHANNELS)
        for number, first, last in sample.stretches.tolist():
            assert 0 <= first < last < trials.episodes[number].calls
            assert last - first < STRETCH
        firsts, lasts = sample.stretches[sample.calls[:, 0], 1:].T
        assert (firsts < sample.calls[:, 1]).all()
        assert (sample.calls[:, 1] <= lasts).all()
    assert not set(trials.learned.episodes) & set(trials.held_out.episodes)


def test_what_confirms_are_other_calls_of_the_held_out_episodes_with_other_noise(trials: Trials) -> None:
    """Half as many at most. Of episodes that have too few others the same, with other noise."""
    trials = replace(trials, observations=4, state=StateFile(None, {}), _samples={})
    asked = {
        part: {(int(one.stretches[s, 0]), int(row)) for s, row in one.calls}
        for part in (HELD_OUT, CONFIRMING)
        for one in (trials.sample(part),)
    }
    assert len(asked[CONFIRMING]) == 2 and not asked[CONFIRMING] & asked[HELD_OUT]
    rows_of = [{key: rows[:2] for key, rows in one.observations.items()} for one in trials.episodes]
    short = [replace(one, observations=rows) for one, rows in zip(trials.episodes, rows_of, strict=True)]
    few = replace(trials, episodes=short, state=StateFile(None, {}), _samples={})
    same, again = few.held_out, few.sample(CONFIRMING)
    assert np.array_equal(same.calls, again.calls) and np.array_equal(same.stretches, again.stretches)
    assert not np.isclose(same.answers, again.answers).any()


@pytest.mark.parametrize(("fits", "drawn"), [(10, 16), (30, 30), (1000, 64)])
def test_of_a_small_network_as_many_calls_are_learned_from_as_fit(
    compiled: Path, recording: Path, tmp_path: Path, fits: int, drawn: int
) -> None:
    """As many are drawn again where a state goes on."""
    trials = trials_of(compiled, recording, tmp_path, limits=CallLimits(8, 16, 64))
    limit = (fits + 0.5) * _seconds(trials.runner.view) / (QUICKLY * trials.until_share)
    trials = replace(trials, clock=Clock(limit))
    assert trials._affordable("calibration") == drawn
    assert replace(trials, clock=Clock(1e6))._affordable("calibration") == drawn


def test_answers_of_a_state_without_their_number_are_the_usual_ones(
    compiled: Path, recording: Path, tmp_path: Path
) -> None:
    trials = trials_of(compiled, recording, tmp_path, clock=Clock(1e6), limits=CallLimits(8, 16, 64))
    trials.state.put("targets", {"calibration": np.zeros((16, 10, policies.HORIZON, policies.CHANNELS), np.float32)})
    assert trials._affordable("calibration") == 16


@pytest.mark.parametrize(("seconds", "draws"), [(1e-9, DRAWS), (1e6, MOST_DRAWS), (np.inf, DRAWS)])
def test_a_small_network_is_asked_more_often(
    compiled: Path, recording: Path, tmp_path: Path, seconds: float, draws: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ttscompile.calibration.trials.MOST_DRAWS", MOST_DRAWS)
    (tmp_path / "usual").mkdir()
    usual = trials_of(compiled, recording, tmp_path / "usual").held_out
    sample = trials_of(compiled, recording, tmp_path, clock=Clock(seconds)).held_out
    assert sample.draws == draws
    same = np.isin(usual.calls @ [STRETCH, 1], sample.calls @ [STRETCH, 1])
    assert np.abs(usual.answers[same] - sample.answers[:, :DRAWS]).max() < 1e-5
    resumed = trials_of(compiled, recording, tmp_path, clock=Clock(1e9))
    assert resumed.state.load()
    assert np.array_equal(resumed.held_out.answers, sample.answers)


def test_answers_are_kept_and_go_on(compiled: Path, recording: Path, tmp_path: Path) -> None:
    whole = trials_of(compiled, recording, tmp_path).held_out.answers
    resumed = trials_of(compiled, recording, tmp_path)
    assert resumed.state.load()
    kept = resumed.state.get(f"{HELD_OUT} answers")
    np.testing.assert_array_equal(kept["samples"].reshape(whole.shape), whole)
    resumed.state.put(f"{HELD_OUT} answers", {**kept, "samples": kept["samples"][:3]})
    np.testing.assert_array_equal(resumed.held_out.answers, whole)
    forged = trials_of(compiled, recording, tmp_path)
    forged.state.put(f"{HELD_OUT} answers", {**kept, "samples": np.zeros((1, 3), np.float32)})
    with pytest.raises(CalibrationError, match="does not fit this calibration"):
        _ = forged.held_out


def test_a_slow_original_answers_fewer_observations_evenly_spread(
    compiled: Path, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("all", "slow", "least"):
        (tmp_path / name).mkdir()
    everything = trials_of(compiled, recording, tmp_path / "all").held_out
    seconds = iter(np.arange(0.0, 1e6, 10.0))  # ten seconds for whatever is done
    monkeypatch.setattr(Clock, "elapsed", lambda self: float(next(seconds)))
    slow = trials_of(compiled, recording, tmp_path / "slow")
    slow = replace(slow, clock=Clock(limit=1000.0))
    count = len(slow.held_out.calls)
    assert FEWEST_OBSERVATIONS <= count < len(everything.calls)
    assert slow.held_out.calls[0].tolist() == everything.calls[0].tolist()
    assert slow.held_out.calls[-1].tolist() == everything.calls[-1].tolist()
    rows = [everything.calls.tolist().index(one) for one in slow.held_out.calls.tolist()]
    np.testing.assert_allclose(slow.held_out.answers[:, :DRAWS], everything.answers[rows], atol=1e-5)
    fastest = replace(trials_of(compiled, recording, tmp_path / "least"), clock=Clock(limit=1.0))
    assert len(fastest.held_out.calls) == min(FEWEST_OBSERVATIONS, len(everything.calls))


@pytest.fixture(scope="session")
def flowing(once: Once) -> Path:
    """A policy whose sampler tells what its sample is made of in the middle."""

    def make(directory: Path) -> None:
        spec = policies.spec()
        sampler = replace(flow_matching_table(policies.STEPS), timesteps=spec.sampler.timesteps)
        ttscompile.compile_denoiser(policies.Mixer(0).eval(), replace(spec, sampler=sampler), directory)

    return once.folder("flowing mixer", make)


def warm(trials: Trials, last: int) -> Proposal:
    dense = trials.artifact.plans["dense"]
    plan = Plan("rest", cells=dense_plan(last, 6), otherwise=dense)
    return Proposal("warm", plan, starts={"rest": StartRecord("original", last)})


@pytest.mark.slow
def test_a_plan_that_begins_with_the_chunk_before_is_judged_in_both_ways(
    flowing: Path, recording: Path, tmp_path: Path
) -> None:
    trials = trials_of(flowing, recording, tmp_path)
    scores = {}
    for last in (1, 9):
        proposal = warm(trials, last)
        held = holding(trials, proposal)
        assert not held.fresh  # onnxruntime can do it
        answers = list(_Answers(held, proposal.plan, held.held_out).all())
        assert len(answers) == 2
        distances = [distance(executed(made), executed(held.held_out.answers)) for made in answers]
        scores[last] = judge(held, proposal.plan)
        assert scores[last].distance == pytest.approx(max(distances), rel=0.1)
        assert distances[0] != distances[1]
        assert scores[last].error is None
        assert scores[last].sparsity == 0.0
        assert timed([(held, proposal.plan)], 1)[0].median > 0
    assert scores[9].distance < scores[1].distance
    assert scores[1].flops_saved > scores[9].flops_saved


def executed(samples: np.ndarray) -> np.ndarray:
    """What is executed, as the network has it."""
    return samples[:, :, 1:5].reshape(*samples.shape[:2], -1).astype(np.float64)


@pytest.mark.slow
def test_of_single_calls_nothing_begins_with_the_chunk_before(flowing: Path, tmp_path: Path) -> None:
    path = tmp_path / "short.npz"
    np.savez(path, obs=np.linspace(-0.1, 0.1, 18, dtype=np.float32).reshape(3, 2, 3), episode_ends=[1, 2, 3])
    trials = trials_of(flowing, path, tmp_path)
    proposal = warm(trials, 3)
    with pytest.raises(CalibrationError, match="is judged on episodes of two calls at least"):
        judge(holding(trials, proposal), proposal.plan)
    assert judge(trials, trials.base).distance == pytest.approx(0.0, abs=1e-3)


def test_calls_are_timed_in_turn(trials: Trials) -> None:
    plans = [trials.artifact.plans["dense"], Plan(cells=uniform_plan(10, 6, 2))]
    times = timed([(trials, plan) for plan in plans], 1, rounds=5)
    assert [len(one.ms) for one in times] == [5, 5]
    assert all(one.median > 0 for one in times)
