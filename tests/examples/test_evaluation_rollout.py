"""Lockstep episodes: what the policy is given, and what is made of what it answers."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from environments.pusht import PushT
from rollout import Episode, run_batch, run_episodes
from variants import NoiseShape, Variant, seeded_noise

from ttscompile import ChunkSpec, ObservationSpec, Source
from ttscompile.errors import TtscompileError

SHAPE = NoiseShape(steps=3, sample=(16, 2), stochastic=True)


class StayAway:
    """Sends the agent to a corner and remembers what it was asked; reports a plan with one reused cell of six."""

    info = SimpleNamespace(observation={"obs": ObservationSpec((2, 20))}, action=ChunkSpec(2, 1, 9))

    def __init__(self) -> None:
        self.resets = 0
        self.asked: list[tuple[np.ndarray, Any, Any]] = []
        self.last_report: SimpleNamespace | None = None

    def reset(self) -> None:
        self.resets += 1

    def predict_action(self, obs: Any, *, noise: Any, plan: Any = None) -> Any:
        windows = obs["obs"]
        self.asked.append((windows, noise, plan))
        plans = np.full((len(windows), 3, 2), Source.COMPUTE, dtype=np.int8)
        plans[:, 2, 1] = Source.TIMESTEP
        count = len(windows)
        self.last_report = SimpleNamespace(plan=plans, flops=(10.0,) * count, legalised=(1,) * count)
        return {"action": np.full((count, 8, 2), 40.0, dtype=np.float32)}


def variant(policy: Any, plan: str | None = None) -> Variant:
    return Variant("v", policy, plan, SHAPE)


def test_score_of_an_episode_is_the_last() -> None:
    one = Episode(3, "", {"obs": np.zeros((4, 2, 20))}, np.zeros((3, 2)), np.array([0.1, 0.8, 0.8]), False, {})
    assert (one.score, one.calls) == (0.8, 4)


def test_noise_is_a_function_of_seed_and_call() -> None:
    together = seeded_noise(SHAPE, [4, 9], call=2)
    alone = seeded_noise(SHAPE, [9], call=2)
    assert together.steps is not None and alone.steps is not None
    assert together.initial.shape == (2, 16, 2)
    assert together.steps.shape == (3, 2, 16, 2)
    assert together.initial.dtype == together.steps.dtype == np.float32
    np.testing.assert_array_equal(together.initial[1:], alone.initial)
    np.testing.assert_array_equal(together.steps[:, 1:], alone.steps)


def test_noise_differs_between_seeds_calls_and_steps() -> None:
    one = seeded_noise(SHAPE, [4, 5], call=0)
    later = seeded_noise(SHAPE, [4, 5], call=1)
    assert one.steps is not None and later.steps is not None
    draws = [one.initial[0], one.initial[1], later.initial[0], later.initial[1], *one.steps[:, 0], *later.steps[:, 0]]
    assert len({draw.tobytes() for draw in draws}) == len(draws)


def test_pinned_noise_is_that_of_the_first_call() -> None:
    pinned = replace(SHAPE, pinned=True)
    first, later = seeded_noise(SHAPE, [4, 5], call=0), seeded_noise(pinned, [4, 5], call=3)
    np.testing.assert_array_equal(later.initial, first.initial)
    np.testing.assert_array_equal(later.steps, first.steps)


def test_other_noise_is_in_no_call_that_is_shared() -> None:
    shared = [seeded_noise(SHAPE, [4, 5], call=call).initial for call in range(4)]
    for shape in (replace(SHAPE, other=True), replace(SHAPE, other=True, pinned=True)):
        again, other = (seeded_noise(shape, [4, 5], call=1).initial for _ in range(2))
        np.testing.assert_array_equal(again, other)
        assert not np.isin(other, shared).any()


def test_another_sampler_starts_from_the_same_noise() -> None:
    fewer = seeded_noise(NoiseShape(steps=2, sample=(16, 2), stochastic=False), [4], call=0)
    np.testing.assert_array_equal(fewer.initial, seeded_noise(SHAPE, [4], call=0).initial)
    assert fewer.steps is None


@pytest.mark.slow
def test_two_policies_see_the_same_noise_and_first_observation() -> None:
    first, second = StayAway(), StayAway()
    run_batch(PushT, variant(first, "dense"), [1, 2])
    run_batch(PushT, variant(second), [1, 2])
    for (_, noise, plan), (_, other, default) in zip(first.asked, second.asked, strict=True):
        np.testing.assert_array_equal(noise.initial, other.initial)
        np.testing.assert_array_equal(noise.steps, other.steps)
        assert plan == "dense"
        assert default is None
    np.testing.assert_array_equal(first.asked[0][0], second.asked[0][0])


def test_the_batch_stays_the_same_when_an_episode_is_done() -> None:
    class OneSolved(PushT):
        def reset(self, seed: int, state: Sequence[float] | None = None) -> None:
            super().reset(seed, [60.0, 60.0, 256.0, 256.0, np.pi / 4] if seed == 1 else state)

    policy = StayAway()
    running: list[int] = []
    result = run_batch(OneSolved, variant(policy), [0, 1], on_call=running.append)
    assert [len(windows) for windows, _, _ in policy.asked] == [2] * 38
    assert [e.calls for e in result.episodes] == [38, 1]
    assert [len(e.actions) for e in result.episodes] == [300, 1]
    assert [e.success for e in result.episodes] == [False, True]
    assert running == [1] * 37 + [0]
    # The finished stream repeats its last observation, and its calls count for nothing.
    np.testing.assert_array_equal(policy.asked[2][0][1], policy.asked[30][0][1])
    assert len(result.sparsity) == len(result.flops) == len(result.legalised) == 39
    assert np.mean(result.sparsity) == pytest.approx(1 / 6)
    assert sum(result.legalised) == 39


@pytest.mark.slow
def test_batches_give_what_single_episodes_give() -> None:
    policy = StayAway()
    done: list[int] = []
    batched = run_episodes(PushT, variant(policy), range(5), batch=2, on_done=done.append)
    assert policy.resets == 3
    assert done[-1] == 5
    assert done == sorted(done)
    for seed in range(5):
        (alone,) = run_batch(PushT, variant(StayAway()), [seed]).episodes
        assert alone.seed == batched.episodes[seed].seed == seed
        np.testing.assert_array_equal(alone.scores, batched.episodes[seed].scores)
        np.testing.assert_array_equal(alone.windows["obs"], batched.episodes[seed].windows["obs"])


class Counting:
    """An environment of numbers: the frame is how many actions were taken, and their sum."""

    title, hz, max_steps, task = "Counting", 1.0, 11, "count"
    measures: Mapping[str, float] = MappingProxyType({})
    displacements: tuple[int, ...] = ()

    def reset(self, seed: int) -> None:
        self.seed, self.steps, self.sum, self.looked = seed, 0, 0.0, 0

    @property
    def done(self) -> bool:
        return self.steps == self.max_steps

    @property
    def success(self) -> bool:
        return self.done

    @property
    def score(self) -> float:
        return self.steps / self.max_steps

    def observe(self) -> Any:
        self.looked += 1
        seen = np.array([self.steps, self.sum], np.float32)
        return {"seen": seen, "seed": np.array([self.seed], np.int64), "unused": np.zeros(7)}

    def step(self, action: Any) -> None:
        assert not self.done
        self.steps, self.sum = self.steps + 1, self.sum + float(action[0])

    def rest(self) -> Any:
        return np.zeros(1, np.float32)

    def picture(self) -> Any:
        raise NotImplementedError

    def close(self) -> None:
        pass


class Adder:
    """Chunks of four actions ``[1]``, each its number in the episode."""

    def __init__(self, frames: int) -> None:
        observation = {"seen": ObservationSpec((frames, 2)), "seed": ObservationSpec((1,), dtype="int64", window=False)}
        self.info = SimpleNamespace(observation=observation, action=ChunkSpec(1, 0, 4))

    def reset(self) -> None:
        self.calls = 0

    def predict_action(self, obs: Any, *, noise: Any, plan: Any = None) -> Any:
        assert obs.keys() == self.info.observation.keys()
        first, self.calls = 4 * self.calls, self.calls + 1
        return {"action": np.arange(first, first + 4, dtype=np.float32).reshape(1, 4, 1)}


@pytest.mark.parametrize("frames", [1, 2, 4, 6])
def test_windows_are_the_last_frames_as_the_policy_specifies(frames: int) -> None:
    made: list[Counting] = []

    def make() -> Counting:
        made.append(Counting())
        return made[-1]

    (one,) = run_batch(make, variant(Adder(frames)), [5]).episodes
    assert one.calls == 3
    assert one.task == "count"
    assert one.windows.keys() == {"seen", "seed"}
    np.testing.assert_array_equal(one.windows["seed"], [[5]] * 3)
    for call in range(3):
        steps = np.maximum(np.arange(4 * call - frames + 1, 4 * call + 1), 0)  # the first frame fills the first window
        np.testing.assert_array_equal(one.windows["seen"][call, :, 0], steps)
        np.testing.assert_array_equal(one.windows["seen"][call, :, 1], steps * (steps - 1) / 2)
    np.testing.assert_array_equal(one.actions[:, 0], np.arange(11))
    np.testing.assert_allclose(one.scores, np.arange(1, 12) / 11)
    seen = min(frames, 4)  # of a chunk; the last one ends after three actions
    assert made[0].looked == 2 + 2 * seen + max(seen - 2, 0), "frames that nobody sees may be images: they cost"


def test_a_policy_of_another_environment_is_refused() -> None:
    with pytest.raises(
        TtscompileError, match=r"v observes \['obs'\] and gives actions of shape \[2\]; Counting offers"
    ):
        run_batch(Counting, variant(StayAway()), [0])
