"""What depends on one frame alone is a piece of its own."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.families import cameras
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.flops import frames_flops, graph_flops
from ttscompile.ir.graph import Node, Ref
from ttscompile.ir.program import Program, once_values
from ttscompile.ir.verify import verify
from ttscompile.passes.split_frames import SplitFrames, _require_apart
from ttscompile.samplers.flow import flow_matching_table


@cache
def compiled(kind: str, told: bool = False) -> Program:
    return transform(*cameras.policy(kind, told))


def convolutions(program: Program) -> int:
    """Those that are in no tower."""
    graphs = [graph for graph in (program.pieces.condition, program.pieces.scene) if graph is not None]
    return sum(node.op.startswith("aten.conv") for graph in graphs for node in graph.nodes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "told", "rows"),
    [("each", False, (2, 2)), ("shared", False, (4,)), ("stacked", False, (4,)), ("each", True, (1, 2, 2))],
)
def test_every_tower_is_a_piece_that_knows_nothing_of_the_window(kind: str, told: bool, rows: tuple[int, ...]) -> None:
    program = compiled(kind, told)
    pieces = program.pieces
    assert tuple(sorted(pieces.rows)) == rows
    assert convolutions(program) == 0
    assert graph_flops(pieces.condition) < 0.01 * frames_flops(pieces)
    # All streams of a batch, by the pieces and by the network as it was captured.
    weights = {name: torch.from_numpy(np.array(value)) for name, value in program.weights.items()}
    rng = np.random.default_rng(0)
    obs = {key: torch.from_numpy(one.draw_normalized(rng, 3)) for key, one in program.spec.observations.items()}

    graphs = pieces.once()
    made = once_values(pieces, lambda name, given: evaluate(graphs[name], weights, given), obs)
    (context,) = (made[name] for name in pieces.conditions)
    module: Any = cameras.policy(kind, told)[0]
    with torch.no_grad():
        expected = module.denoiser.read(module.encoder(obs))[:, None]
    torch.testing.assert_close(context, expected, rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mixed", "channels"])
def test_what_needs_the_whole_window_stays(kind: str) -> None:
    program = compiled(kind)
    assert program.pieces.towers == ()
    assert program.pieces.frames is None
    assert convolutions(program) > 0


class OneCamera(nn.Module):
    """A camera, of which a call sees one frame, and a state."""

    def __init__(self) -> None:
        super().__init__()
        self.tower, self.read = cameras.Patches("siglip"), nn.Linear(8 + 4, cameras.ACTIONS)

    def forward(self, sample: Tensor, timestep: Tensor, image: Tensor, state: Tensor) -> Tensor:
        read = self.read(torch.cat([self.tower(image[:, -1]), state], -1))
        return sample + torch.relu(sample + read[:, None])


@pytest.mark.slow
def test_a_picture_alone_is_a_row_of_its_own() -> None:
    """One camera and one frame, as most vision-language-action models have them: the axis of frames has size 1."""
    torch.manual_seed(0)
    frame = ObservationSpec((1, 3, cameras.SIDE, cameras.SIDE), bounds=(0.0, 1.0))
    observations = {"image": frame, "state": ObservationSpec((4,), window=False)}
    shape, steps = (cameras.HORIZON, cameras.ACTIONS), flow_matching_table(cameras.STEPS)
    program = transform(OneCamera().eval(), PolicySpec(shape, observations, steps, ChunkSpec(cameras.ACTIONS, 0, 2)))
    pieces = program.pieces
    assert (pieces.rows, convolutions(program)) == ((1,), 0)
    assert list(pieces.tokens) == ["pixels_00", "tokens_00"]
    assert graph_flops(pieces.condition) < 0.01 * frames_flops(pieces)


@pytest.mark.slow
def test_what_costs_less_than_looking_stays() -> None:
    program = compiled("each")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ttscompile.driver.SplitFrames", lambda: SplitFrames(10**12))
        whole = transform(*cameras.policy("each"))
    cost = max(graph_flops(tower) for tower in program.pieces.towers)
    assert SplitFrames(cost)(whole).program.pieces.rows == program.pieces.rows
    assert SplitFrames(cost + 1)(whole).program.pieces.towers == ()


def test_a_second_run_changes_nothing() -> None:
    program = compiled("shared")
    assert SplitFrames()(program).program is program


def test_towers_of_one_network_are_one_piece_and_hold_its_weights_once() -> None:
    shared, each = compiled("shared"), compiled("each")
    assert len(shared.pieces.towers) == 1
    assert len(each.pieces.towers) == 2
    assert not set(each.pieces.towers[0].constants) & set(each.pieces.towers[1].constants)


def test_rows_that_are_not_apart_are_refused() -> None:
    program = compiled("each")
    tower = program.pieces.towers[0]
    (name,) = tower.outputs
    last = tower.producers()[name]
    mixed = Node("mixed", "aten.flip.default", last.args, (), last.types)
    mixed = replace(mixed, args=(Ref(next(iter(last.refs()))), (0,)))
    broken = replace(tower, nodes=(*tower.nodes[:-1], mixed, replace(last, args=(Ref("mixed"),))))
    _require_apart(SplitFrames(), tower, program.weights)
    with pytest.raises(PassError, match="depends on the other rows"):
        _require_apart(SplitFrames(), broken, program.weights)


def test_a_tower_without_its_rows_is_seen() -> None:
    program = compiled("each")
    frames = program.pieces.frames
    assert frames is not None
    fewer = replace(frames, outputs=frames.outputs[:1])
    with pytest.raises(PassError, match="the towers read"):
        verify(replace(program, pieces=replace(program.pieces, frames=fewer)))
