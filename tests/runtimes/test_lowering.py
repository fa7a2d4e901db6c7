"""Instructions against section 2 executed literally, and what makes them few."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Source
from ttscompile.core.lattice import PlanArray, dense_plan, uniform_plan
from ttscompile.errors import IllegalPlanError
from ttscompile.runtimes.instructions import Instructions, instructions_of
from ttscompile.runtimes.onnxruntime.decode import decode_first, decode_rest
from ttscompile.runtimes.plans import LoweringCache

from .literal import Episode, Toy
from .plans import random_plan

C, F, T, R = Source.COMPUTE, Source.FORWARD, Source.TIMESTEP, Source.ROLLOUT


class FakeIdle:
    """What ``IdleSteps`` is to the loop: a total that is taken in."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.total, self.prepared = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def prepare(self) -> None:
        self.prepared[:] = self.total


class FakeWorkspace:
    """The interface of ``Workspace`` over a numpy block function: a stream is a vector, and all follow one plan.

    Args:
        rng: of the policy's weights.
        axis: of the streams in the residual stream.
    """

    def __init__(self, rng: np.random.Generator, steps: int, groups: tuple[int, ...], streams: int, axis: int) -> None:
        self.groups, self.streams, self.axis = groups, streams, axis
        blocks = len(groups)
        self._w = rng.standard_normal((blocks, 4, 4)) / 4  # rounding must not grow from block to block
        self._c = rng.standard_normal((steps, blocks, streams, 1, 4))
        shape = (streams, 3, 4) if axis == 0 else (3, streams, 4)
        self.x = np.zeros((streams, 3, 4))
        self.fresh, self.hidden = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.sample = [np.zeros((streams, 3, 4), np.float32) for _ in range(2)]
        self.current = np.full((blocks, *shape), np.nan, np.float32)
        self.table = np.full((blocks, *shape), np.nan, np.float32)
        self.rollout: dict[int, np.ndarray] = {}
        self.runs: list[tuple[int, int]] = []
        self.dense: list[int] = []
        self.idle = FakeIdle(shape) if rng.random() < 0.8 else None
        self.idled: list[int] = []

    def toy(self, s: int) -> Toy:
        """The policy of stream s."""
        return Toy(
            self.groups,
            stem=lambda x, k: 0.5 * x,
            block=lambda h, k, b: np.tanh(h @ self._w[b] + self._c[k, b, s]),
            advance=lambda h, x, k: 0.3 * x + np.tanh(h),
        )

    def begin(self) -> None:
        self.sample[0][:] = self.x
        np.moveaxis(self.fresh, self.axis, 0)[:] = 0.5 * self.x
        self.hidden[:] = np.nan

    def entry(self, cell: int) -> np.ndarray:
        return self.rollout.setdefault(cell, np.full(self.hidden.shape, np.nan, np.float32))

    def sums(self, count: int) -> np.ndarray:
        return np.full((count, *self.hidden.shape), np.nan, np.float32)

    def run_dense(self, k: int) -> None:
        self.dense.append(k)
        self.hidden[:] = self.fresh
        for b in range(len(self.groups)):
            self.run(k, b)
            self.hidden += self.current[b]

    def enter_idle(self, k: int) -> None:
        assert self.idle is not None
        self.idle.prepared[:] = np.nan

    def run_idle(self, first: int, stop: int) -> None:
        assert self.idle is not None
        for k in range(first, stop):
            self.hidden[:] = self.fresh + self.idle.prepared
            self.advance(k)
            self.idled.append(k)

    def leave_idle(self, k: int) -> None:
        self.hidden[:] = np.nan

    def run(self, k: int, b: int) -> None:
        self.runs.append((k, b))
        own, h = np.moveaxis(self.current[b], self.axis, 0), np.moveaxis(self.hidden, self.axis, 0)
        for s in range(self.streams):
            own[s] = self.toy(s).block(h[s], k, b)

    def advance(self, k: int) -> None:
        now, then = k % 2, (k + 1) % 2
        h = np.moveaxis(self.hidden, self.axis, 0)
        self.sample[then][:] = 0.3 * self.sample[now] + np.tanh(h)
        np.moveaxis(self.fresh, self.axis, 0)[:] = 0.5 * self.sample[then]


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    steps=st.integers(1, 7),
    groups=st.lists(st.integers(0, 2), min_size=1, max_size=7).map(tuple),
    streams=st.integers(1, 4),
    axis=st.integers(0, 1),
    computed=st.floats(0, 1),
)
def test_instructions_do_what_section_2_says(
    seed: int, steps: int, groups: tuple[int, ...], streams: int, axis: int, computed: float
) -> None:
    rng = np.random.default_rng(seed)
    work = FakeWorkspace(rng, steps, groups, streams, axis)
    cache = LoweringCache(partial(instructions_of, groups=groups))
    episodes = [Episode(work.toy(s)) for s in range(streams)]
    written = np.zeros((steps, len(groups)), np.bool_)
    keep = rng.random((steps, len(groups))) < rng.choice([0.0, 0.5, 1.0])
    for _ in range(3):
        plan = random_plan(rng, steps, groups, written, computed)
        work.x = rng.standard_normal((streams, 3, 4))
        if rng.random() < 0.5:  # many steps in a row without a computed block
            plan[rng.random(steps) < 0.8] = T
            plan[0] = C
        for log in (work.runs, work.dense, work.idled):
            log.clear()
        decode_first(work, keep)  # type: ignore[arg-type]
        decode_rest(work, cache.lower(plan), keep)  # type: ignore[arg-type]
        expected = [episode.call(work.x[s], plan) for s, episode in enumerate(episodes)]
        # Residual and stream are rounded for each block, three values for each step; sums of up to four.
        terms = 4**2 * steps * (2 * len(groups) + 3)
        assert_equal_but_for_rounding(work.sample[steps % 2], np.stack(expected), terms)
        assert work.runs == list(map(tuple, np.argwhere(plan == C).tolist()))  # nothing else, and nothing twice
        assert work.dense == np.flatnonzero((plan == C).all(axis=1)).tolist()
        assert not (plan == C)[work.idled].any()
        written |= (plan == C) & keep


def sums(lowered: Instructions) -> list[list[tuple[str, int]]]:
    """Instructions by step, readable: ``("run", b)``, ``("new", slot)``, ``("old", slot)``."""
    listed = []
    gaps = iter(lowered.gaps)
    for step in lowered.computed.tolist():
        line: list[tuple[str, int]] = []
        for b, computed in enumerate(step):
            if computed:
                line.append(("run", b))
            elif b == 0 or step[b - 1]:
                slot, start, stop, _ = next(gaps)
                line.append(("new" if start < stop else "old", slot))
        listed.append(line)
    assert next(gaps, "end") == "end"
    assert lowered.counts == tuple(sum(step) for step in lowered.computed.tolist())
    assert lowered.cells == tuple(np.flatnonzero(lowered.computed).tolist())
    assert len(lowered.load_rows) == len(lowered.load_from) == sum(loads for *_, loads in lowered.gaps)
    return listed


def loads(lowered: Instructions) -> list[tuple[int, int]]:
    return list(zip(lowered.load_rows, lowered.load_from, strict=True))


def segments(lowered: Instructions) -> int:
    """How many sums are made in a call."""
    return sum(start != stop for _, start, stop, _ in lowered.gaps)


def test_the_docstrings_example() -> None:
    plan = np.array([[C] * 7, [C, T, T, C, F, T, T]], np.int8)
    lowered = instructions_of(plan, [0, 1, 2, 0, 0, 1, 2])
    assert sums(lowered)[1] == [("run", 0), ("new", 0), ("run", 3), ("new", 0)]
    assert loads(lowered) == [(1, ~1), (2, ~2), (4, ~3), (5, ~5), (6, ~6)]
    assert (segments(lowered), lowered.slots) == (2, 1)


def test_steps_that_compute_nothing_are_one_addition_of_one_sum() -> None:
    lowered = instructions_of(uniform_plan(100, 24, 5), [0, 1, 2] * 8)
    assert segments(lowered) == 5
    assert [line for line in sums(lowered) if ("old", 0) not in line and ("new", 0) not in line] == [
        [("run", b) for b in range(24)]
    ] * 5
    assert sum(line == [("old", 0)] for line in sums(lowered)) == 90


def test_a_sum_is_made_again_when_one_of_its_residuals_is() -> None:
    plan = np.array([[C, C, C], [T, T, T], [C, T, T], [T, T, T], [R, T, T]], np.int8)
    lowered = instructions_of(plan, [0, 1, 2])
    assert sums(lowered) == [
        [("run", 0), ("run", 1), ("run", 2)],
        [("new", 0)],
        [("run", 0), ("new", 0)],
        [("new", 0)],
        [("new", 0)],
    ]
    # Rows 1 and 2 of the table are loaded once; row 0 in steps 1, 3 and 4.
    assert loads(lowered) == [(0, ~0), (1, ~1), (2, ~2), (0, ~0), (0, 4 * 3)]
    assert np.argwhere(lowered.rollout).tolist() == [[4, 0]]


def test_the_same_residuals_by_another_way_are_the_same_sum() -> None:
    plan = np.array([[C, C], [F, T], [T, F]], np.int8)  # F of block 0 is block 1's residual, and F of block 1 too
    assert segments(instructions_of(plan, [0, 0])) == 2
    crossed = np.array([[C, C, C], [T, F, T], [T, T, F]], np.int8)  # residuals {0, 2, 2} and {0, 1, 2}
    assert segments(instructions_of(crossed, [0, 1, 1])) == 2
    same = np.array([[C, C, C], [T, F, T], [T, F, F]], np.int8)
    assert segments(instructions_of(same, [0, 1, 1])) == 1


def test_slots_are_kept_while_their_sum_is_needed() -> None:
    plan = np.array([[C, C, C], [T, C, T], [T, C, T]], np.int8)
    assert sums(instructions_of(plan, [0, 1, 2]))[1:] == [
        [("new", 0), ("run", 1), ("new", 1)],
        [("old", 0), ("run", 1), ("old", 1)],
    ]


def test_a_dense_plan_has_no_sums() -> None:
    lowered = instructions_of(dense_plan(3, 2), [0, 1])
    assert sums(lowered) == [[("run", 0), ("run", 1)]] * 3
    assert (segments(lowered), lowered.slots, loads(lowered)) == (0, 0, [])


def test_a_plan_of_timestep_alone_sums_residuals_where_they_are() -> None:
    plan = np.array([[C, C, C], [T, C, T], [T, T, T]], np.int8)
    assert (instructions_of(plan, [0, 0, 1]).table, loads(instructions_of(plan, [0, 0, 1]))) == (False, [])
    plan[2, 1] = F
    assert instructions_of(plan, [0, 0, 1]).table


@pytest.mark.parametrize("plan", [[[T, C], [C, C]], [[C, R], [C, C]], [[F, C], [C, C]]])
def test_an_illegal_plan_is_refused(plan: list[list[Source]]) -> None:
    with pytest.raises(IllegalPlanError, match="step 0 must be dense"):
        instructions_of(np.array(plan, np.int8), [0, 0])


def test_the_cache_keeps_the_plans_used_last() -> None:
    cache = LoweringCache(partial(instructions_of, groups=[0, 0]), capacity=2)

    def plan(b: int) -> PlanArray:
        return np.array([[C, C], [C if b == 0 else T, C if b == 1 else F]], np.int8)

    first, second = cache.lower(plan(0)), cache.lower(plan(1))
    assert cache.lower(plan(0)) is first
    cache.lower(plan(2))
    assert cache.lower(plan(0)) is first
    assert cache.lower(plan(1)) is not second
