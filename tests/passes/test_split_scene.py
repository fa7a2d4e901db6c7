"""What pictures and words decide together, whatever the state, is a piece of its own."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from tests.families import cameras, scenes
from tests.families.scenes import When
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.flops import graph_flops, once_flops
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType
from ttscompile.ir.program import Program, once_values
from ttscompile.ir.verify import verify
from ttscompile.lower.integer_convolution import DYNAMIC_PRODUCT
from ttscompile.lower.precision import lower_precision, parts_to_lower
from ttscompile.lower.program import lower_graphs
from ttscompile.passes.split_frames import SplitFrames, _beside, _parted

LAYER = 2 * scenes.WIDTH * 8 * scenes.WIDTH
"""FLOPs of the products by constants of one row in one layer."""


@cache
def compiled(when: When = "apart", frames: int = 1) -> Program:
    return transform(*scenes.policy(when, frames))


@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("when", ["apart", "last"])
def test_a_scene_is_all_that_the_state_does_not_reach(when: When, frames: int) -> None:
    program = compiled(when, frames)
    pieces = program.pieces
    assert pieces.scene is not None
    assert pieces.rows == (2 * frames,)
    assert "state" not in pieces.scene.inputs
    assert next(iter(pieces.condition.inputs)) == "state"
    assert not {*cameras.CAMERAS, "tokens", *pieces.towers[0].outputs} & {*pieces.condition.inputs}
    rows = 2 * frames + cameras.WORDS
    assert graph_flops(pieces.scene) > 2 * rows * LAYER, "two layers, and keys and values of the third"
    late = graph_flops(pieces.condition) / LAYER
    assert (2 < late < 2.5) if when == "last" else late < 0.2, "one row more, and what reads the state"
    # All streams of a batch, by the pieces and by the network as it was captured.
    weights = {name: torch.from_numpy(np.array(value)) for name, value in program.weights.items()}
    rng = np.random.default_rng(0)
    obs = {key: torch.from_numpy(one.draw_normalized(rng, 3)) for key, one in program.spec.observations.items()}
    graphs = pieces.once()
    made = once_values(pieces, lambda name, given: evaluate(graphs[name], weights, given), obs)
    (name,) = pieces.conditions
    module = scenes.policy(when, frames)[0]
    with torch.no_grad():
        expected = module.denoiser.read(module.encoder(obs))[:, None]  # type: ignore[operator, union-attr]
    torch.testing.assert_close(made[name], expected, rtol=0, atol=1e-5)


def notes(program: Program) -> tuple[str, ...]:
    """Of the pass, where there are towers already."""
    whole = scenes.without_scene(program).pieces
    return SplitFrames()._with_scene(replace(program, pieces=whole))[1]


def test_where_the_language_model_reads_the_state_it_is_computed_in_every_call() -> None:
    program = compiled("first")
    assert program.pieces.scene is None
    assert len(program.pieces.towers) == 1
    told = f"{graph_flops(program.pieces.condition) / 1e6:.1f} MFLOP in every call, since they read %state"
    assert notes(program) == (told,)


def test_it_is_told_what_a_scene_saves() -> None:
    scene = compiled().pieces.scene
    assert scene is not None
    share = graph_flops(scene) / once_flops(compiled().pieces)
    told = f"{share:.0%} of what is known before the loop, {graph_flops(scene) / 1e6:.1f} MFLOP, once a scene"
    assert notes(compiled()) == (told,)


def test_a_second_run_changes_nothing() -> None:
    program = compiled()
    assert SplitFrames()(program).program is program


def test_a_policy_of_whose_pictures_little_is_made_has_none() -> None:
    pieces = transform(*cameras.policy("stacked")).pieces
    assert pieces.towers
    assert pieces.scene is None, "features and state are put side by side"


def test_rows_of_a_stream_that_are_not_together_are_seen() -> None:
    """As where frames come before streams: the second half is of the newest frames, not of the second stream."""
    kind = TensorType((Batch(), 2, 3), "float32")
    turned, rows = TensorType((2, Batch(), 3), "float32"), TensorType((Batch(2), 3), "float32")
    turn = Node("turned", "aten.transpose.int", (Ref("x"), 0, 1), (), (turned,))
    flat = Node("rows", "aten.reshape.default", (Ref("turned"), rows.shape), (), (rows,))
    assert _beside(Graph({"x": kind}, {}, (turn, flat), ("rows",)), {}) == ["rows"]
    assert _beside(Graph({"x": kind}, {}, (replace(flat, args=(Ref("x"), rows.shape)),), ("rows",)), {}) == []


def test_a_tower_that_nobody_reads_is_seen() -> None:
    program = compiled()
    scene = program.pieces.scene
    assert scene is not None
    (name,) = program.pieces.towers[0].outputs
    inputs = {key: kind for key, kind in scene.inputs.items() if key != name}
    broken = replace(scene, inputs={**inputs, "other": scene.inputs[name]})
    broken = broken.renamed({name: "other"})
    broken = replace(broken, inputs={**inputs, "other": scene.inputs[name]})
    with pytest.raises(PassError, match=f"%{name} of a tower is no input"):
        verify(replace(program, pieces=replace(program.pieces, scene=broken)))


@pytest.mark.parametrize("when", ["apart", "last"])
def test_what_may_multiply_by_the_weights_of_the_scene_has_its_precision(
    when: When, monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces = compiled(when).pieces
    assert pieces.scene is not None
    least = graph_flops(pieces.scene) / sum(graph_flops(block.graph) for block in pieces.blocks)
    monkeypatch.setattr("ttscompile.lower.precision.LEAST_SHARE", least)  # of which the condition graph has less
    assert {"scene", "condition"} <= {*parts_to_lower(compiled(when))[0]}
    found, _, told = parts_to_lower(compiled(when), ("scene",))
    assert "condition" not in found
    assert any(note.startswith("condition stays fp32: ") for note in told)


@pytest.mark.parametrize(("when", "rows"), [("apart", 0), ("last", 8)])
def test_one_row_is_in_eight_bits_where_its_weights_are(when: When, rows: int) -> None:
    """Of the third layer keys and values alone are read; what the state alone is multiplied by stays as it is."""
    program = compiled(when)
    assert program.pieces.scene is not None
    graphs = {"scene": program.pieces.scene, "condition": program.pieces.condition}
    models, weights, _ = lower_precision(lower_graphs(graphs), program.weights, "int8", ("scene", "condition"))
    products = {
        name: [node.input[1] for node in model.graph.node if node.op_type == DYNAMIC_PRODUCT]
        for name, model in models.items()
    }
    assert len(products.get("condition", [])) == rows + (when == "last")
    assert {*products.get("condition", [])} <= {*products["scene"]}, "the same integers"
    assert {*products["scene"]} <= {*weights}


def test_a_picture_that_is_handed_on_is_no_reason_to_compute_a_scene_again() -> None:
    """It stays with what runs in every call. What is made of it is of the scene, as is what is handed on of words."""
    shown, row = TensorType((Batch(), 1, 3, 4, 4), "float32"), TensorType((Batch(), 8), "float32")
    features, flat = TensorType((Batch(), 2, 2, 2), "float32"), TensorType((Batch(), 8), "float32")
    given = {"camera": shown, "other": shown, "seen.frame": features, "words": row, "state": row}
    nodes = (
        Node("copy", "aten.clone.default", (Ref("camera"),), (), (shown,)),
        Node("again", "aten.clone.default", (Ref("other"),), (), (shown,)),
        Node("twice", "aten.add.Tensor", (Ref("again"), Ref("again")), (), (shown,)),
        Node("told", "aten.clone.default", (Ref("words"),), (), (row,)),
        Node("rows", "aten.reshape.default", (Ref("seen.frame"), flat.shape), (), (flat,)),
        Node("kept", "aten.clone.default", (Ref("seen.frame"),), (), (features,)),
        Node("keys", "aten.add.Tensor", (Ref("rows"), Ref("words")), (), (row,)),
        Node("late", "aten.add.Tensor", (Ref("state"), Ref("keys")), (), (row,)),
    )
    scene, rest = _parted(Graph(given, {}, nodes, ("copy", "twice", "told", "kept", "late")), ["state"])
    assert "camera" not in scene.inputs
    assert {"other", "seen.frame", "words"} == {*scene.inputs}
    assert {"keys", "twice", "told", "kept"} <= {*scene.outputs}
    assert set(rest.outputs) == {"copy", "late"}
    assert {"state", "camera", "keys"} == {*rest.inputs}
