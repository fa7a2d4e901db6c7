"""The server that a fleet of robots asks: it checks what they send, and lets the copies of the policy answer.

``server.listener`` says who may come in. A robot is a client and has one request at a time; those of many robots are
under way together, and copies answer those of one plan in batches (``copies``).
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.coercion import Array
from ttscompile.core.tokenizer import TASK
from ttscompile.core.values import fitted
from ttscompile.errors import DeadlineMissedError, IllegalPlanError, ObservationError, OverloadedError
from ttscompile.runtimes.arrays import image_remedy
from ttscompile.runtimes.instruct import Instruct
from ttscompile.runtimes.liveness import reads_earlier_calls

from .admission import ServerLimits
from .listener import Listener
from .lock import Lock
from .protocol import Metric, Request, read_frame

METHODS = {"info": frozenset[str](), "predict": frozenset({"obs", "plan"})}

BOUNDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
"""Seconds: of requests that took no longer is counted how many there were."""


class Answered(NamedTuple):
    """What a copy answers: actions ``[Ta, Da]``, and whether this was the first request of its batch."""

    actions: Array
    first: bool


class Plans(NamedTuple):
    """Names of the plans that a fleet may ask for, and the one of requests that name none."""

    names: tuple[str, ...]
    default: str

    @classmethod
    def of(cls, artifact: Artifact, default: str | None = None) -> Plans:
        """Those of an artifact, and the default, which may be one in another precision; None for the artifact's own.

        Raises:
            IllegalPlanError: there is no such plan, or it reads the call before, which here is another robot's.
        """
        plans = {name: plan for name, plan in artifact.plans.items() if plan.otherwise is None}
        names = tuple(name for name, plan in plans.items() if not reads_earlier_calls(view_of(artifact, plan), plan))
        default = artifact.manifest.default_plan if default is None else default
        if default not in names:
            cls(names, default).known(default.partition("@")[0])
            artifact.plan(default)  # which knows what precisions there are
            names = (*names, default)
        return cls(names, default)

    def known(self, plan: str) -> str:
        """The name, if it is one of these. Raises IllegalPlanError: see above."""
        if plan not in self.names:
            why = "plans that read the call before are left out, since that may be another robot's"
            raise IllegalPlanError(f"plan {plan[:40]!r} cannot run here: expected one of {list(self.names)}; {why}.")
        return plan


class Copies(Protocol):
    """Copies of the policy, wherever they are."""

    async def predict(self, plan: str, obs: Mapping[str, Array]) -> Answered:
        """Answer an observation of one stream, without the axis of the batch, or raise why the policy refuses it."""

    async def trouble(self) -> str:
        """Why no copy can answer at present; empty where one can."""


class FleetServer(Listener):
    """Serves one artifact to many robots.

    Args:
        artifact: loaded and checked; only what it says of itself is looked at.
        plan: of requests that name none; None for the artifact's default.
        waiting: requests that may be under way; further ones are refused.
        limits: what clients may do; None for the defaults.
        lock: who may come in; None lets every program of this machine in, and nobody else.
        instruct: of a policy that reads an instruction, so that robots may send it as text.

    Raises:
        IllegalPlanError: see ``Plans.of``.
    """

    methods = METHODS

    def __init__(
        self,
        artifact: Artifact,
        copies: Copies,
        plan: str | None = None,
        waiting: int = 256,
        limits: ServerLimits | None = None,
        lock: Lock | None = None,
        instruct: Instruct | None = None,
    ) -> None:
        super().__init__(limits, lock)
        self._manifest, self._copies, self._most = artifact.manifest, copies, waiting
        self._plans = Plans.of(artifact, plan)
        self._specs = artifact.manifest.spec.observations
        self._instruct = instruct
        self._waiting = 0
        self._seconds: Counter[float] = Counter()
        self._took = 0.0
        self._streams: Counter[str] = Counter()
        self._batches: Counter[str] = Counter()

    async def do(self, request: Request) -> dict[str, Any]:
        """See ``Listener``."""
        if request.method == "info":
            return {**self._facts(), "plans": list(self._plans.names), "default_plan": self._plans.default}
        plan = self._plans.known(request.params.get("plan") or self._plans.default)
        obs = await self.apart(request.large, self._checked, request.params["obs"])
        if self._waiting >= self._most:
            problem = f"{self._waiting} requests are under way, and that is how many may be"
            raise OverloadedError(f"{problem}. Ask again later, or let the fleet have more copies.")
        return {"action": (await self._ask(plan, obs)).tolist()}

    def _facts(self) -> dict[str, Any]:
        chunk = self._manifest.spec.chunk
        return {
            "observation": {key: {"shape": list(one.shape), "dtype": one.dtype} for key, one in self._specs.items()},
            "action": {"shape": [chunk.executes, chunk.action_dim], "dtype": "float32"},
            "identity": self._manifest.identity,
            "max_message_bytes": self._limits.message_bytes,
            "idle_timeout": self._limits.idle_timeout,
        }

    async def _ask(self, plan: str, obs: Mapping[str, Array]) -> Array:
        start, limit = time.monotonic(), self._limits.action_timeout
        self._waiting += 1
        try:
            answered = await asyncio.wait_for(self._copies.predict(plan, obs), limit)
        except asyncio.TimeoutError as error:
            raise DeadlineMissedError(f"no copy answered within {limit:g} s.") from error
        finally:
            self._waiting -= 1
            took = time.monotonic() - start
            self._took += took
            self._seconds[next((bound for bound in BOUNDS if took <= bound), float("inf"))] += 1
        self._streams[plan] += 1
        self._batches[plan] += answered.first
        return answered.actions

    def _checked(self, given: Mapping[str, Any]) -> dict[str, Array]:
        """The arrays of an observation: one that does not fit must not fail the others of its batch."""
        frame: Mapping[str, Any] = read_frame(given, self._specs)
        obs = dict(frame if self._instruct is None else self._instruct.of_frame(frame))
        if obs.keys() != self._specs.keys():
            text = " Text needs a server with a tokenizer (serve: --tokenizer)." * (TASK in obs)
            raise ObservationError(f"expected an observation of {sorted(self._specs)}; found {sorted(obs)[:20]}.{text}")
        for key, one in self._specs.items():
            array = obs[key] = fitted(obs[key], one, f"observation {key!r}")
            if (array.shape, str(array.dtype)) != (one.shape, one.dtype) or not np.isfinite(array).all():
                found = f"{array.dtype} {list(array.shape)}.{image_remedy(array[None], one)}"
                expected = f"{one.dtype} {list(one.shape)}, of finite numbers"
                raise ObservationError(f"observation {key!r} must be {expected}; found {found}")
        return obs

    async def trouble(self) -> str:
        """See ``Listener``."""
        return await self._copies.trouble()

    def metrics(self) -> list[Metric]:
        """See ``Listener``."""
        below, buckets = 0, list[tuple[Mapping[str, str], float]]()
        for bound in (*BOUNDS, float("inf")):
            below += self._seconds[bound]
            buckets.append(({"le": "+Inf" if bound == float("inf") else repr(bound)}, below))
        by_plan = {
            "streams_total": ("Requests that were computed, by plan.", self._streams),
            "batches_total": ("Calls of the policy that computed them, by plan.", self._batches),
        }
        return [
            Metric("artifact_info", "gauge", "The artifact.", [({"identity": self._manifest.identity}, 1)]),
            Metric("waiting", "gauge", "Requests under way.", [({}, self._waiting)]),
            Metric("request_seconds", "histogram", "From a request to its answer.", buckets, self._took),
            *(
                Metric(name, "counter", what, [({"plan": plan}, count) for plan, count in counts.items()])
                for name, (what, counts) in by_plan.items()
            ),
        ]
