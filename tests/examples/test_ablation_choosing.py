"""What choosing call by call could gain, on errors that are made up: where it can, and where it only seems so."""

from __future__ import annotations

from dataclasses import replace

import choosing
import numpy as np
import pytest
from choosing import AFTER, OBSERVATION, SINGLE, Choice, Errors, choices

OBSERVATIONS, DRAWS, SCHEDULES, EPISODES = 120, 4, 6, 12


def made(seed: int, follows: str, steps: np.ndarray) -> Errors:
    """Errors around 1, less by more computed steps; the best schedule follows something that is known, or nothing."""
    rng = np.random.default_rng(seed)
    known = {
        "the observation": np.repeat(rng.standard_normal((OBSERVATIONS, 1, 8)), DRAWS, 1),
        "the noise": rng.standard_normal((OBSERVATIONS, DRAWS, 5)),
    }
    errors = np.exp(0.3 * rng.standard_normal((OBSERVATIONS, DRAWS, SCHEDULES))) / steps
    if follows in known:
        better = np.einsum("orn,ns->ors", known[follows], np.eye(known[follows].shape[2], SCHEDULES))
        errors *= np.exp(-better)
    if follows == "difficulty":  # some calls gain much by further steps, and the observation tells which
        hard = np.exp(2 * known["the observation"][..., :1])
        errors = hard / steps**2 + 0.01 * errors
    return Errors(errors, np.arange(OBSERVATIONS) % EPISODES, known)


def found(follows: str, steps: np.ndarray | None = None) -> dict[str, Choice]:
    steps = np.full(SCHEDULES, 3) if steps is None else steps
    return {one.name: one for one in choices(made(0, follows, steps), made(1, follows, steps), steps, 3, seed=0)}


def test_nothing_is_gained_where_nothing_can_be_known() -> None:
    """The best of each call after the fact is luck: judged on other draws nothing of it is left."""
    rows = found("nothing")
    assert rows[SINGLE].gain == 0 and rows[SINGLE].steps == 3
    assert rows[AFTER].gain > 0.2
    for name in (OBSERVATION, "the observation", "the noise", "all of these"):
        low, high = rows[name].interval
        assert low <= 0.02 and high < 0.1, name


@pytest.mark.parametrize("follows", ["the observation", "the noise"])
def test_what_is_known_is_found(follows: str) -> None:
    rows = found(follows)
    other = {"the observation": "the noise", "the noise": "the observation"}[follows]
    for name in (follows, "all of these"):
        assert rows[name].gain > 0.5 * rows[AFTER].gain > 0
        assert rows[name].interval[0] > 0
    assert rows[other].gain < 0.25 * rows[AFTER].gain
    assert (rows[OBSERVATION].gain > 0.3) == (follows == "the observation")


def test_one_episode_to_learn_from_teaches_next_to_nothing() -> None:
    """No other one says how much of what is seen there holds elsewhere, so next to nothing of it is believed."""
    steps = np.full(SCHEDULES, 3)
    learned = replace(made(0, "nothing", steps), episodes=np.zeros(OBSERVATIONS, np.int64))
    guessed = choosing._predicted(learned, made(1, "nothing", steps), "all of these", relative=True)[1]
    spread = (np.log(learned.of) - np.log(learned.of).mean(2, keepdims=True)).std()
    assert guessed.std((0, 1)).max() < 0.01 * spread


def test_hard_calls_get_more_steps() -> None:
    """As many as allowed on average: after the fact exactly, by the prediction about."""
    rows = found("difficulty", np.array([2, 2, 3, 3, 4, 4]))
    after, predicted = rows[f"{AFTER}; 3 steps on average"], rows["all of these; 3 steps on average"]
    assert after.steps <= 3 and after.gain > rows[AFTER].gain + 0.05
    assert predicted.steps == pytest.approx(3, abs=0.4)
    assert predicted.interval[0] > 0 and predicted.gain <= after.gain


def test_the_interval_holds_the_gain_and_errors_are_means() -> None:
    rows = found("the observation")
    judged = made(1, "the observation", np.full(SCHEDULES, 3)).of
    assert rows[AFTER].error == pytest.approx(judged.min(2).mean())
    assert rows[AFTER].gain == pytest.approx(1 - rows[AFTER].error / rows[SINGLE].error)
    for one in rows.values():
        assert one.interval[0] <= one.gain <= one.interval[1]
