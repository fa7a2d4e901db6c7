"""Jumps: fitted to what is not linear, judged on other episodes, and carried out as they were fitted."""

import numpy as np
import pytest
import torch

from ttscompile.calibration import sparse_loop
from ttscompile.calibration.calls import IntArray
from ttscompile.calibration.regression import FOLDS, Layers, fit_jump
from ttscompile.calibration.sparse_loop import SparseLoop, fit_correction
from ttscompile.core.correction import HIDDEN
from ttscompile.core.lattice import PlanArray
from ttscompile.runtimes.reference.sampler import through

from .tasks import MakeTask

pytestmark = pytest.mark.usefixtures("long_training")


def drawn(calls: int, noise: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Eight numbers that are read, neither centred nor scaled, and two that are not linear in them."""
    draw = torch.Generator().manual_seed(0)
    known = torch.randn(calls, 8, generator=draw)
    missing = torch.stack([known[:, 0].abs(), known[:, 1] * known[:, 2]], 1) - 0.5
    return 5 * known + 3, 0.01 * missing + noise * torch.randn(calls, 2, generator=draw)


@pytest.mark.slow
def test_it_finds_what_is_not_linear() -> None:
    known, missing = drawn(4000)
    found = fit_jump(known, missing, np.arange(4000) % 40, 0)
    assert found is not None
    layers, added = found
    assert [tuple(layer.shape) for layer in layers] == [(9, HIDDEN), (HIDDEN + 1, HIDDEN), (HIDDEN + 1, 2)]
    assert (missing - through(layers, known)).square().mean() < 0.02 * missing.var()
    assert (missing - added).square().mean() < 0.05 * missing.var()


def test_what_does_not_hold_on_other_episodes_is_no_jump() -> None:
    known, _ = drawn(400)
    random = torch.randn(400, 2, generator=torch.Generator().manual_seed(1))
    assert fit_jump(known, random, np.arange(400) % 40, 0) is None


def test_a_call_is_judged_by_what_other_episodes_say() -> None:
    """An episode that is unlike all others is not known from them, and so its own calls do not tell what it needs."""
    known, missing = drawn(1200)
    episodes: IntArray = np.arange(1200) % 12
    alone = torch.from_numpy(episodes == 5)
    known[alone], missing[alone] = known[alone] + 100, missing[alone] + 1
    found = fit_jump(known, missing, episodes, 0)
    assert found is not None
    left = (missing - found[1]).square()
    assert left[alone].mean() > 0.1 > 100 * left[~alone].mean()


@pytest.mark.parametrize("episodes", [1, FOLDS - 1])
def test_few_episodes_give_none(episodes: int) -> None:
    known, missing = drawn(300)
    assert fit_jump(known, missing, np.arange(300) % episodes, 0) is None


def test_the_same_calls_give_the_same_bytes() -> None:
    known, missing = drawn(600)
    one, two = (fit_jump(known, missing, np.arange(600) % 8, 3) for _ in range(2))
    assert one is not None and two is not None
    assert all(torch.equal(a, b) for a, b in zip(one[0], two[0], strict=True))


@pytest.mark.parametrize("reads", [True, False])
def test_calls_end_where_the_fitted_jumps_lead_them(
    make_task: MakeTask, monkeypatch: pytest.MonkeyPatch, reads: bool
) -> None:
    """What the loop does while it fits them is what a correction with them does; the second of three is none."""
    task = make_task(calls=60)
    steps, plan = task.runner.model.steps, task.whole.plan([0, 3, 6, 9])
    assert steps == 10
    made: list[int] = []

    def drawn_jump(
        known: torch.Tensor, missing: torch.Tensor, episodes: IntArray, seed: int
    ) -> tuple[Layers, torch.Tensor] | None:
        made.append(seed)
        if len(made) == 2:
            return None
        draw = torch.Generator().manual_seed(seed)
        sizes = (known.shape[1], HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, missing.shape[1])
        inner, middle, outer = (torch.randn(a + 1, b, generator=draw) / a for a, b in sizes)
        return (inner, middle, outer), through((inner, middle, outer), known)

    monkeypatch.setattr(sparse_loop, "TERMS", (drawn_jump,))
    some, others = (task.runner.select(task.calls, part) for part in (range(40), range(40, 60)))
    loop = SparseLoop(task.runner, some, others, reads=reads, whole=True)
    plain, place = loop.ends(plan)
    correction = loop.correction(place)
    assert correction is not None
    assert made == [2, 5, 8]
    assert correction.landings == {2: 0, 5: 1, 8: 2}
    assert not correction.outer[1].any() and correction.outer[0].any()
    manifest = task.runner.view.manifest
    correction.require_fit(steps, manifest.spec.sample, manifest.condition_numbers)
    ran = task.runner.corrected(correction).run(plan, others)
    torch.testing.assert_close(place.samples, ran, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(plain.samples, loop.end(plan).samples)
    assert (plain.samples - place.samples).abs().max() > 1e-3


def test_without_a_jump_that_holds_there_are_none(make_task: MakeTask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sparse_loop, "TERMS", (lambda *given: None,))
    task = make_task(calls=60)
    plan: PlanArray = task.whole.plan([0, 5])
    loop = SparseLoop(task.runner, task.calls, None, reads=True, whole=True)
    plain, jumping = loop.ends(plan)
    assert plain is jumping
    correction = loop.correction(jumping)
    assert correction is not None and not correction.jumps


@pytest.mark.parametrize("helps", [True, False])
def test_jumps_stay_if_the_loop_ends_nearer_to_the_dense_policy(
    make_task: MakeTask, monkeypatch: pytest.MonkeyPatch, helps: bool
) -> None:
    """Each jump may hold by itself, and the corrections after it be worse for it."""
    task = make_task(calls=400)

    def exact_or_worse(
        known: torch.Tensor, missing: torch.Tensor, episodes: IntArray, seed: int
    ) -> tuple[Layers, torch.Tensor]:
        sizes = (known.shape[1], HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, missing.shape[1])
        inner, middle, outer = (torch.zeros(a + 1, b) for a, b in sizes)
        draw = torch.Generator().manual_seed(seed)
        return (inner, middle, outer), missing if helps else torch.randn(missing.shape, generator=draw)

    monkeypatch.setattr(sparse_loop, "TERMS", (exact_or_worse,))
    correction = fit_correction(task.runner, task.whole.plan([0, 6]), task.calls, True)
    assert correction is not None
    assert bool(correction.landings) == helps
