"""The floor of large policies: FLOPs of what a call computed, at the rate of a product."""

from dataclasses import replace

import numpy as np
import pytest
from large_calls import Arithmetic
from rate import COLUMNS, ROWS, WIDTH, ProductRate

from tests.families import cameras
from tests.once import Once
from ttscompile.artifact.load import load_artifact
from ttscompile.core.plan import TokenReuse
from ttscompile.ir.flops import graph_flops
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy


def test_frames_that_are_known_and_tokens_that_stay_cost_nothing(once: Once) -> None:
    artifact = load_artifact(cameras.compiled_tokens(once) / "artifact")
    arithmetic, (tower,) = Arithmetic(artifact), artifact.pieces.towers
    rng = np.random.default_rng(0)
    seen = {key: one.draw(rng) for key, one in artifact.manifest.spec.observations.items()}

    def called(policy: CompiledPolicy) -> list[float]:
        policy.predict_action(seen)
        assert policy.last_report is not None
        before, loop = arithmetic.of(policy.last_report)
        assert loop == policy.last_report.flops[0] - artifact.manifest.flops.prologue
        return [before, policy.last_report.frames.tokens]

    reusing = replace(artifact.plans["dense"], tokens=TokenReuse(threshold=0.0, refresh=1000))
    policy = open_policy(artifact, seed=0, plan=reusing)
    assert called(policy)[0] == artifact.manifest.flops.prologue
    known = artifact.manifest.flops.prologue - cameras.TO * len(cameras.CAMERAS) * graph_flops(tower)
    assert called(policy)[0] == known
    image = seen[cameras.CAMERAS[0]]
    image[0, -1, :, :4, :4] = 1 - image[0, -1, :, :4, :4]  # one patch of one frame
    before, tokens = called(policy)
    assert 0 < tokens < 37 / 2
    assert before == pytest.approx(known + graph_flops(tower) * tokens / 37)


@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_the_rate_is_that_of_the_product(precision: str) -> None:
    product = ProductRate(precision)
    for _ in range(3):
        product.run()
    kinds = {"fp32": "MatMul", "int8": "DynamicQuantizeMatMul"}
    assert [node.op_type for node in product.model.graph.node] == [kinds[precision]]
    flops = 2 * ROWS * WIDTH * COLUMNS
    assert product.seconds(2 * flops) == pytest.approx(2 * product.seconds(flops))
    assert product.seconds(flops) > 0
