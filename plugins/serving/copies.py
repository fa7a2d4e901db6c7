"""Copies of a policy on a Ray cluster, which answer requests of one plan in batches (Ray Serve)."""

import asyncio
import signal
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from ttscompile.core.coercion import Array
from ttscompile.errors import ArtifactChangedError, ClusterError, TtscompileError, first_line, needing
from ttscompile.runtimes.load import load

from .fleet import Answered

LOCAL = "local"
"""In the place of an address: a cluster of this machine's cores, for as long as the server runs."""
HEALTH_SECONDS = 5.0
"""What the cluster may take to say how it is."""

Outcome = Answered | TtscompileError


@dataclass(frozen=True)
class FleetSettings:
    """How copies are made, and how they put requests together.

    Attributes:
        batch: streams of one call, at most.
        wait_ms: for which a request waits for others of its plan.
    """

    copies: int = 1
    threads: int = 1
    batch: int = 16
    wait_ms: float = 5.0


class Copy:
    """One copy of the policy, in a process of the cluster.

    Each call is an episode of its own: the streams of a batch are other robots from call to call. An observation that
    the policy refuses fails alone.

    Raises:
        ArtifactChangedError: this machine has another artifact there.
    """

    def __init__(self, artifact: str, identity: str, settings: FleetSettings) -> None:
        self._policy = load(artifact, threads=settings.threads, seed=None)
        if self._policy.info.identity != identity:
            raise ArtifactChangedError(
                f"{artifact}: a machine of the cluster has another artifact there. Copy it again."
            )
        self._settings = settings
        self._worker = ThreadPoolExecutor(1)  # one call at a time: a copy has its threads and no more
        self._together: dict[str, Callable[[Mapping[str, Array]], Coroutine[Any, Any, Outcome]]] = {}

    async def predict(self, plan: str, obs: Mapping[str, Array]) -> Outcome:
        """The answer to one request; an error of ours is handed over as it is, which Ray would put into one of its."""
        if plan not in self._together:
            from ray import serve

            settings = self._settings

            async def together(several: list[Mapping[str, Array]]) -> list[Outcome]:
                loop = asyncio.get_running_loop()
                return await loop.run_in_executor(self._worker, partial(self._call, plan, several))

            self._together[plan] = serve.batch(
                together, max_batch_size=settings.batch, batch_wait_timeout_s=settings.wait_ms / 1000
            )
        return await self._together[plan](obs)

    def _call(self, plan: str, several: Sequence[Mapping[str, Array]]) -> list[Outcome]:
        stacked = {key: np.stack([obs[key] for obs in several]) for key in several[0]}
        self._policy.reset()
        try:
            actions = self._policy.predict_action(stacked, plan=plan)["action"]
        except TtscompileError as error:
            if len(several) > 1:
                return [self._call(plan, [obs])[0] for obs in several]
            return [type(error)(str(error))]  # without what it holds on to
        return [Answered(each, i == 0) for i, each in enumerate(actions)]


class RayCopies:
    """``server.Copies`` behind a handle of Ray Serve."""

    def __init__(self, handle: Any, name: str) -> None:
        self._handle, self._name = handle, name

    async def predict(self, plan: str, obs: Mapping[str, Array]) -> Answered:
        """See ``Copies``. A request whose copy dies is given to another one by Ray Serve, or fails."""
        from ray.exceptions import RayError

        try:
            outcome: Outcome = await self._handle.predict.remote(plan, obs)
        except RayError as error:
            raise ClusterError(f"a copy failed: {first_line(error)}. Ask again.") from error
        if isinstance(outcome, TtscompileError):
            raise outcome
        return outcome

    async def trouble(self) -> str:
        """See ``Copies``."""
        from ray import serve

        try:
            found = await asyncio.wait_for(asyncio.to_thread(serve.status), HEALTH_SECONDS)
        except Exception as error:  # whatever Ray raises where there is no cluster any more
            return f"the cluster does not answer: {first_line(error)}"
        application = found.applications.get(self._name)
        state = "gone" if application is None else application.status.value
        return "" if state == "RUNNING" else f"the copies are {state}"


@contextmanager
def ray_copies(address: str, artifact: Path, identity: str, settings: FleetSettings) -> Iterator[RayCopies]:
    """Start copies on a cluster, and end them.

    No port is opened by Ray Serve: robots come through the server, and its lock.

    Raises:
        RuntimeUnavailableError: Ray is not installed.
        ClusterError: nothing answers at the address, or the copies do not start.
    """
    with needing("a fleet", "ray,serve"):
        import ray
        from ray import serve
    name = f"ttscompile-{uuid4().hex[:12]}"  # a cluster may have several fleets
    given: dict[str, Any] = {"num_cpus": settings.copies * settings.threads} if address == LOCAL else {}
    ended = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(
            address=address,
            include_dashboard=False if given else None,
            log_to_driver=False,
            logging_level="error",
            **given,
        )
    except Exception as error:  # a node that does not start in time raises a bare one
        raise ClusterError(f"--ray {address}: no cluster can be reached ({first_line(error)}).") from error
    finally:
        if signal.getsignal(signal.SIGTERM) is not ended:  # Ray's own would end the command with status 15
            signal.signal(signal.SIGTERM, ended)
    try:
        serve.start(proxy_location="Disabled")
        deployment = serve.deployment(
            Copy,
            name="policy",
            num_replicas=settings.copies,
            max_ongoing_requests=4 * settings.batch,
            ray_actor_options={"num_cpus": settings.threads},
        )
        try:
            handle = serve.run(
                deployment.bind(str(artifact.resolve()), identity, settings), name=name, route_prefix=None
            )
        except RuntimeError as error:
            remedy = "All machines need the packages and the artifact under the same path, and cores for the copies"
            raise ClusterError(f"the copies did not start: {first_line(error)}. {remedy}.") from error
        yield RayCopies(handle, name)
    finally:
        if address == LOCAL:
            serve.shutdown()
        else:
            serve.delete(name)
        ray.shutdown()
