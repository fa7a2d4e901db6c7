"""Lockstep episodes: what the policy is given, and what is made of what it answers."""

from types import SimpleNamespace

import numpy as np
import pytest
from rollout import Episode, NoiseShape, run_batch, run_episodes, seeded_noise

from ttscompile import Source

SHAPE = NoiseShape(steps=3, sample=(16, 2), stochastic=True)


class StayAway:
    """Sends the agent to a corner and remembers what it was asked; reports a plan with one reused cell of six."""

    def __init__(self) -> None:
        self.resets = 0
        self.asked: list[tuple[np.ndarray, object, object]] = []
        self.last_report: SimpleNamespace | None = None

    def reset(self):
        self.resets += 1

    def predict_action(self, obs, *, noise, plan=None):
        windows = obs["obs"]
        self.asked.append((windows, noise, plan))
        plans = np.full((len(windows), 3, 2), Source.COMPUTE, dtype=np.int8)
        plans[:, 2, 1] = Source.TIMESTEP
        count = len(windows)
        self.last_report = SimpleNamespace(plan=plans, flops=(10.0,) * count, legalised=(1,) * count)
        return {"action": np.full((count, 8, 2), 40.0, dtype=np.float32)}


def episode(coverages, seed=0):
    steps = len(coverages)
    return Episode(
        seed=seed,
        windows=np.zeros((1, 2, 20), np.float32),
        states=np.zeros((steps + 1, 5)),
        targets=np.zeros((steps, 2)),
        coverages=np.array(coverages),
    )


@pytest.mark.parametrize(
    ("coverages", "best", "score", "success"),
    [
        ([0.0, 0.0], 0.0, 0.0, False),
        ([0.1, 0.76, 0.38], 0.76, 0.8, False),
        ([0.5, 0.95], 0.95, 1.0, False),  # more than 0.95 is success, as in gym-pusht
        ([0.5, 0.96], 0.96, 1.0, True),
    ],
)
def test_score_of_an_episode(coverages, best, score, success):
    one = episode(coverages)
    assert one.best_coverage == best
    assert one.score == pytest.approx(score)
    assert one.success is success


def test_noise_is_a_function_of_seed_and_call():
    together = seeded_noise(SHAPE, [4, 9], call=2)
    alone = seeded_noise(SHAPE, [9], call=2)
    assert together.initial.shape == (2, 16, 2)
    assert together.steps.shape == (3, 2, 16, 2)
    assert together.initial.dtype == together.steps.dtype == np.float32
    np.testing.assert_array_equal(together.initial[1:], alone.initial)
    np.testing.assert_array_equal(together.steps[:, 1:], alone.steps)


def test_noise_differs_between_seeds_calls_and_steps():
    one = seeded_noise(SHAPE, [4, 5], call=0)
    later = seeded_noise(SHAPE, [4, 5], call=1)
    draws = [one.initial[0], one.initial[1], later.initial[0], later.initial[1], *one.steps[:, 0], *later.steps[:, 0]]
    assert len({draw.tobytes() for draw in draws}) == len(draws)


def test_another_sampler_starts_from_the_same_noise():
    fewer = seeded_noise(NoiseShape(steps=2, sample=(16, 2), stochastic=False), [4], call=0)
    np.testing.assert_array_equal(fewer.initial, seeded_noise(SHAPE, [4], call=0).initial)
    assert fewer.steps is None


def test_two_policies_see_the_same_noise_and_first_observation():
    first, second = StayAway(), StayAway()
    run_batch(first, [1, 2], SHAPE, plan="dense")
    run_batch(second, [1, 2], SHAPE)
    for (_, noise, plan), (_, other, default) in zip(first.asked, second.asked, strict=True):
        np.testing.assert_array_equal(noise.initial, other.initial)
        np.testing.assert_array_equal(noise.steps, other.steps)
        assert plan == "dense"
        assert default is None
    np.testing.assert_array_equal(first.asked[0][0], second.asked[0][0])


def test_the_batch_stays_the_same_when_an_episode_is_done(monkeypatch):
    solved = [60.0, 60.0, 256.0, 256.0, np.pi / 4]
    import rollout

    class OneSolved(rollout.PushT):
        def reset(self, seed, state=None):
            return super().reset(seed, solved if seed == 1 else None)

    monkeypatch.setattr(rollout, "PushT", OneSolved)
    policy = StayAway()
    running = []
    result = run_batch(policy, [0, 1], SHAPE, on_call=running.append)
    assert [len(windows) for windows, _, _ in policy.asked] == [2] * 38
    assert [len(e.windows) for e in result.episodes] == [38, 1]
    assert [e.success for e in result.episodes] == [False, True]
    assert running == [1] * 37 + [0]
    # The finished stream repeats its last observation, and its calls count for nothing.
    np.testing.assert_array_equal(policy.asked[2][0][1], policy.asked[30][0][1])
    assert len(result.sparsity) == len(result.flops) == len(result.legalised) == 39
    assert np.mean(result.sparsity) == pytest.approx(1 / 6)
    assert sum(result.legalised) == 39


def test_batches_give_what_single_episodes_give():
    policy = StayAway()
    done = []
    batched = run_episodes(policy, range(5), SHAPE, batch=2, on_done=done.append)
    assert policy.resets == 3
    assert done[-1] == 5
    assert done == sorted(done)
    for seed in range(5):
        (alone,) = run_batch(StayAway(), [seed], SHAPE).episodes
        assert alone.seed == batched.episodes[seed].seed == seed
        np.testing.assert_array_equal(alone.states, batched.episodes[seed].states)
        np.testing.assert_array_equal(alone.windows, batched.episodes[seed].windows)


def test_windows_are_consecutive_calls():
    (one,) = run_batch(StayAway(), [0], SHAPE).episodes
    assert one.windows.shape == (38, 2, 20)
    assert one.windows.dtype == np.float32
    for call in range(1, 38):
        agents = one.windows[call][:, 18:]
        np.testing.assert_array_equal(agents, one.states[8 * call - 1 : 8 * call + 1, :2].astype(np.float32))
