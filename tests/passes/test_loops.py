"""Several loops in one program, against programs that have one of them each."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.passes.loops import LOOPS, program_of, spec
from ttscompile.errors import PassError
from ttscompile.ir.verify import verify

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    "kind", ["tokens", *(pytest.param(kind, marks=pytest.mark.soak) for kind in ("adaLN", "skip", "encoder"))]
)
@pytest.mark.parametrize("loop", ["original", "ddim-3"])
def test_a_loop_is_what_it_is_in_a_program_of_its_own(kind: str, loop: str) -> None:
    """Tables, plan head and FLOPs; the rest is common."""
    whole, alone = program_of(kind), program_of(kind, loop)
    found = whole.in_loop(loop)
    assert found.spec.sampler.same_as(alone.spec.sampler) and not found.spec.loops
    assert found.pieces.tables.keys() == alone.pieces.tables.keys()
    for name, rows in alone.pieces.tables.items():
        np.testing.assert_array_equal(found.pieces.tables[name], rows)
    assert found.pieces.graphs() == alone.pieces.graphs() == whole.pieces.graphs() | found.pieces.graphs()
    assert found.weights.keys() == alone.weights.keys()
    for name, value in alone.weights.items():
        np.testing.assert_array_equal(found.weights[name], value)
    assert (found.dense_flops, found.once_flops) == (alone.dense_flops, alone.once_flops)
    assert (found.unmoved is None) == (alone.unmoved is None) == (kind != "skip")
    if found.unmoved is not None and alone.unmoved is not None:
        assert found.unmoved.sampler.same_as(alone.unmoved.sampler)


def test_an_encoder_runs_once_a_call_in_every_loop() -> None:
    """Its FLOPs, and those of what follows from it alone, are not multiplied by the steps."""
    whole = program_of("encoder")
    assert whole.once_flops == 2 * 3 * 7 * 7 + 2 * 3 * 7 * 16  # 3 frames of 7 numbers, and their embedding
    assert program_of("tokens").once_flops == 0
    of_a_step = (whole.dense_flops - whole.once_flops) // 6
    assert of_a_step * 6 + whole.once_flops == whole.flops_of("original") == whole.dense_flops
    assert whole.flops_of("ddim-3") == of_a_step * 3 + whole.once_flops


def test_the_original_has_the_names_that_it_has_alone() -> None:
    whole, alone = program_of("tokens"), program_of("tokens", "original")
    assert whole.graphs() == alone.graphs()
    assert list(whole.pieces.loop_tables) == list(LOOPS)
    assert {rows.shape[0] for rows in whole.pieces.loop_tables["ddim-3"].values()} == {3}
    # The loop of as many steps has the original's plan head.
    assert list(whole.pieces.loop_pruners) == list(whole.loop_weights) == ["ddpm-4", "ddim-3", "dpmsolver++-4"]


def test_the_skip_is_moved_into_the_tables_of_all_loops() -> None:
    whole, given = program_of("skip"), spec()
    assert whole.unmoved is not None
    for name, before in given.all_loops.items():
        assert whole.unmoved.all_loops[name].same_as(before)
        assert whole.spec.all_loops[name].same_as(before.with_skip())
        assert not before.with_skip().same_as(before)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda p: {"loop_tables": {n: t for n, t in p.loop_tables.items() if n != "ddim-3"}}, "tables of the loops"),
        (lambda p: {"loop_tables": {**p.loop_tables, "ddim-3": {}}}, "loop ddim-3: the table of"),
        (lambda p: {"loop_tables": {**p.loop_tables, "ddim-3": p.tables}}, "loop ddim-3: the table of"),
        (lambda p: {"loop_pruners": {}}, r"pruner@ddpm-4: constant %pruner.step is float32\[4, 4\]; its type says"),
    ],
)
def test_what_does_not_fit_is_refused(broken: Callable[..., dict[str, object]], message: str) -> None:
    program = program_of("tokens")
    verify(program)
    with pytest.raises(PassError, match=message):
        verify(replace(program, pieces=replace(program.pieces, **broken(program.pieces))))  # type: ignore[arg-type]


def test_constants_of_a_loops_plan_head_are_checked() -> None:
    program = program_of("tokens")
    weights = {**program.loop_weights, "ddim-3": program.loop_weights["ddpm-4"]}
    with pytest.raises(PassError, match=r"pruner@ddim-3: constant %pruner.hidden.weight is float32\[16, 48\]"):
        verify(replace(program, loop_weights=weights))
    with pytest.raises(PassError, match="pruner@ddpm-4: of 6 steps reads .*; expected 4 steps"):
        verify(replace(program, pieces=replace(program.pieces, loop_pruners={}), loop_weights={}))
