"""The compiled policy as a Ray Serve deployment, for many robots that ask at once: requests are computed in batches.

    pip install 'ttscompile[ray]'
    python examples/ray_serve/deployment.py build/pusht/compiled --robots 16

A robot that is far from its computer wants ``AsyncExecutor`` beside it; this is for a fleet, in simulation or at a
site with a server. Robots that ask within a few milliseconds of each other are one call of the policy: a batch of B
streams costs less than B calls. Each call is an episode of its own (the streams of a batch change from call to call),
so plans that read the call before, ROLLOUT, are refused.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import time
from typing import Any

import numpy as np
from ray import serve

import ttscompile
from ttscompile import Source
from ttscompile.artifact.load import load_artifact


@serve.deployment(ray_actor_options={"num_cpus": 1}, max_ongoing_requests=64)
class CompiledPolicy:
    """One copy of the policy.

    Args:
        artifact: directory or zip.
        plan: to run; None for the artifact's default.
        threads: of the policy.
    """

    def __init__(self, artifact: str, plan: str | None = None, threads: int = 1) -> None:
        loaded = load_artifact(artifact)
        self._plan = plan or loaded.manifest.default_plan
        schedule = loaded.schedules.get(self._plan)
        if schedule is not None and (schedule == Source.ROLLOUT).any():
            raise ValueError(f"plan {self._plan!r} reads residuals of the call before, which here is another robot's.")
        self._policy = ttscompile.load(artifact, threads=threads)
        self._batches: list[int] = []

    @serve.batch(max_batch_size=16, batch_wait_timeout_s=0.005)
    async def predict(self, observations: list[dict[str, Any]]) -> list[Any]:
        """Actions ``[Ta, Da]`` for each observation, ``{key: [...]}`` without the axis of the batch.

        An observation that does not fit fails alone.
        """
        answers: list[Any] = [None] * len(observations)
        good: list[int] = []
        for i, obs in enumerate(observations):
            try:
                self._check(obs)
                good.append(i)
            except ttscompile.TtscompileError as error:
                answers[i] = error
        if good:
            self._batches.append(len(good))
            actions = await asyncio.to_thread(self._call, [observations[i] for i in good])
            for i, action in zip(good, actions, strict=True):
                answers[i] = action
        return answers

    async def __call__(self, request: Any) -> Any:
        """HTTP: POST ``{"obs": {key: nested lists}}``; answers ``{"action": nested lists}``."""
        body = await request.json()
        specs = self._policy.info.observation
        try:
            obs = {key: np.asarray(value, specs[key].dtype) for key, value in body["obs"].items() if key in specs}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            return {"error": f"expected {{'obs': {{key: nested lists}}}}: {error}"}
        answer = await self.predict(obs)
        if isinstance(answer, Exception):
            return {"error": str(answer)}
        return {"action": answer.tolist()}

    def batches(self) -> list[int]:
        """Streams of each call so far."""
        return self._batches

    def _check(self, obs: dict[str, Any]) -> None:
        specs = self._policy.info.observation
        if obs.keys() != specs.keys():
            raise ttscompile.TtscompileError(f"expected an observation of {sorted(specs)}; found {sorted(obs)}.")
        for key, spec in specs.items():
            array = obs[key]
            fits = isinstance(array, np.ndarray) and (array.shape, array.dtype) == (spec.shape, spec.dtype)
            if not fits or not np.isfinite(array).all():
                raise ttscompile.TtscompileError(
                    f"observation {key!r} must be {spec.dtype} {list(spec.shape)}, finite."
                )

    def _call(self, observations: list[dict[str, Any]]) -> Any:
        stacked = {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
        self._policy.reset()  # the streams of this batch are others than those of the one before
        return self._policy.predict_action(stacked, plan=self._plan)["action"]


async def fleet(handle: Any, robots: int, rounds: int, frame: dict[str, Any]) -> list[float]:
    """Let robots ask all at once, again and again; seconds of each round."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        answers = await asyncio.gather(*(handle.predict.remote(frame) for _ in range(robots)))
        assert not any(isinstance(answer, Exception) for answer in answers)
        times.append(time.perf_counter() - start)
    return times


def main() -> None:
    """Start the deployment, let a fleet ask, and say how the requests were batched."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("artifact")
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--plan")
    arguments = parser.parse_args()
    handle = serve.run(CompiledPolicy.bind(arguments.artifact, arguments.plan))
    try:
        specs = ttscompile.load(arguments.artifact).info.observation
        frame = {key: np.full(spec.shape, 250, spec.dtype) for key, spec in specs.items()}
        times = asyncio.run(fleet(handle, arguments.robots, arguments.rounds, frame))
        batches = handle.batches.remote().result()
    finally:
        serve.shutdown()
    print(
        json.dumps(
            {
                "robots": arguments.robots,
                "requests": arguments.robots * arguments.rounds,
                "calls": len(batches),
                "mean_batch": float(np.mean(batches)),
                "median_round_ms": 1e3 * float(np.median(times)),
            }
        )
    )


if __name__ == "__main__":
    main()
