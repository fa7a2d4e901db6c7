"""Inputs for calls that stand for any other: to time them, or to hold two precisions against each other."""

import numpy as np

from ttscompile.core.coercion import Array
from ttscompile.core.spec import Noise, PolicySpec

Observation = dict[str, Array]


def random_calls(spec: PolicySpec, count: int, seed: int) -> list[tuple[Observation, Noise]]:
    """Observations of one stream, and noise, for consecutive calls; more of a seed begin with the same ones."""
    return [random_call(spec, number, seed) for number in range(count)]


def random_call(spec: PolicySpec, number: int, seed: int) -> tuple[Observation, Noise]:
    """The call of this number among ``random_calls``."""
    rng = np.random.default_rng((number, seed))
    obs: Observation = {key: observation.draw(rng) for key, observation in spec.observations.items()}
    return obs, random_noise(spec, rng)


def random_noise(spec: PolicySpec, rng: np.random.Generator) -> Noise:
    """Noise of one stream for a call in any loop of a policy: each takes of the draws what it needs (``check_noise``).

    As many numbers are drawn whether or not a sampler is stochastic.
    """
    loops = spec.all_loops.values()
    initial = spec.draw_initial(rng, (1, *spec.sample))
    draws = rng.standard_normal((max(loop.steps for loop in loops), *initial.shape), dtype=np.float32)
    return Noise(initial, draws if any(loop.stochastic for loop in loops) else None)


def noise_of_any_horizon(spec: PolicySpec, rng: np.random.Generator, streams: int) -> Noise:
    """Noise of calls in a loop. It is drawn for the original's whole horizon, so a seed means the same for any."""
    shape, predicted = (streams, *spec.whole_horizon.sample), spec.sample[0]
    initial = spec.draw_initial(rng, shape)[:, :predicted]
    if not spec.sampler.stochastic:
        return Noise(initial)
    return Noise(initial, rng.standard_normal((spec.sampler.steps, *shape), dtype=np.float32)[:, :, :predicted])


def normalized(spec: PolicySpec, obs: Observation) -> Observation:
    """What the network is given of an observation as ``predict_action`` takes it."""
    return {key: one.normalized(obs[key]) for key, one in spec.observations.items()}
