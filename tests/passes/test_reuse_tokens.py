"""A tower that is a vision transformer has a form for some of its tokens."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from tests.families import cameras
from tests.literal_tokens import LiteralTokens
from ttscompile.capture.export import capture
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Node, Ref, backward_slice
from ttscompile.ir.pieces import INDEX, NOT_KEPT, PIXELS, PLACES, ROWS
from ttscompile.ir.program import Program
from ttscompile.ir.tokens import find_tokens
from ttscompile.ir.verify import verify
from ttscompile.passes.reuse_tokens import ReuseTokens
from ttscompile.samplers.flow import flow_matching_table

pytestmark = pytest.mark.slow


@cache
def compiled(kind: str) -> Program:
    return transform(*cameras.policy(kind))


@pytest.mark.parametrize(
    ("kind", "tokens", "fixed"), [("clip", 37, 1), ("siglip", 36, 0), ("qwen", 36, 0), ("windows", 36, 0)]
)
def test_some_tokens_give_what_they_literally_give(kind: str, tokens: int, fixed: int) -> None:
    program = compiled(kind)
    literal = LiteralTokens(program.pieces.towers[0], program.weights)
    assert (literal.stream.tokens, literal.stream.fixed) == (tokens, fixed)
    weights = {name: torch.from_numpy(np.array(value)) for name, value in program.weights.items()}
    pixels, part = program.pieces.tokens["pixels_00"], program.pieces.tokens["tokens_00"]
    kept = {name: torch.full(t.at(1), torch.nan) for name, t in part.inputs.items() if name not in NOT_KEPT}
    rng, (name,) = np.random.default_rng(0), program.pieces.towers[0].inputs
    calls: list[tuple[Sequence[int], dict[int, int]]] = [
        (range(tokens), {}),
        ([0, 3, 4], {}),
        ([35, 7, 2, 20, 11], {1: 7, 30: 7, 5: 35}),
        (range(tokens), {}),
        ([5], {6: 5}),
    ]
    for computed, similar in calls:
        row = rng.random((1, 3, cameras.SIDE, cameras.SIDE), dtype=np.float32)
        (cut,) = evaluate(pixels, weights, {name: torch.from_numpy(row)})
        index, left = torch.tensor(list(computed)), len(computed) - len(similar)
        places = torch.tensor([*computed, *similar, *computed[:left]])
        rows = torch.tensor([list(computed).index(similar.get(place, place)) for place in places.tolist()])
        value, *renewed = evaluate(part, weights, {PIXELS: cut, INDEX: index, PLACES: places, ROWS: rows, **kept})
        kept = dict(zip(kept, renewed, strict=True))
        np.testing.assert_allclose(value, literal(row, list(computed), similar)[0], rtol=0, atol=1e-5)
    whole = evaluate(program.pieces.towers[0], weights, {name: torch.from_numpy(row)})[0]
    assert (whole - value).abs().max() > 1e-3, "tokens that were not computed keep what they gave"


def test_a_second_run_changes_nothing() -> None:
    assert ReuseTokens()(compiled("clip")).program is compiled("clip")


def test_of_a_convolutional_tower_the_frame_is_the_unit() -> None:
    program = compiled("shared")
    assert program.pieces.tokens == {}
    assert (
        ReuseTokens()(program).notes[0].startswith("frame_00: the whole frame is the unit: it is convolutional: %conv")
    )


def test_a_form_that_gives_something_else_is_refused() -> None:
    program = compiled("clip")
    part = program.pieces.tokens["tokens_00"]
    *nodes, last = part.nodes
    source = next(iter(last.refs()))
    wrong = Node("wrong", "aten.neg.default", (Ref(source),), (), (part.types()[source],))
    broken = replace(part, nodes=(*nodes, wrong, last.renamed(lambda name: "wrong" if name == source else name)))
    pieces = replace(program.pieces, tokens={**program.pieces.tokens, "tokens_00": broken})
    verify(replace(program, pieces=pieces))
    with pytest.raises(PassError, match=r"ReuseTokens: %.*\.frame of all tokens is not what the tower gives"):
        ReuseTokens().ensures(replace(program, pieces=pieces))


class Small(nn.Module):
    """A vision transformer of one layer, with one thing that may be otherwise."""

    def __init__(self, change: str) -> None:
        super().__init__()
        self.change = change
        stride, width = (2, 8) if change == "overlap" else (4, 8)
        self.patch = nn.Conv2d(3, width, 4, stride=stride)
        self.place = nn.Parameter(torch.randn(16, width))
        self.qkv, self.out, self.head = nn.Linear(width, 3 * width), nn.Linear(width, width), nn.Linear(width, 8)

    def forward(self, sample: Tensor, timestep: Tensor, image: Tensor) -> Tensor:
        seen = 2 * image - 1
        x = self.patch(seen[..., :10, :10] if self.change == "overlap" else seen)
        if self.change == "transposed":
            x = x.transpose(2, 3)
        x = x.flatten(2).transpose(1, 2) + self.place
        if self.change == "smeared":
            x = x + image.mean((1, 2, 3))[:, None, None]
        q, k, v = self.qkv(functional.layer_norm(x, (8,))).unflatten(-1, (3, 8)).unbind(2)
        mask = torch.ones(16, 16).tril() if self.change == "masked" else None
        if self.change == "masked by the picture":
            mask = seen.mean((1, 2, 3))[:, None, None, None] + torch.ones(16, 16)
        mixed = functional.scaled_dot_product_attention(
            q[:, None], k[:, None], v[:, None], attn_mask=mask, is_causal=self.change == "causal"
        )
        if self.change == "written out":
            mixed = torch.softmax(q @ k.transpose(1, 2), -1)[:, None] @ v[:, None]
        x = x + self.out(mixed[:, 0])
        if self.change == "beside":
            x = torch.cat([x[:, :8], x[:, 8:]], 1)
        if self.change == "averaged":
            x = x + self.out(x.mean(1, keepdim=True))
        for _ in range(0 if self.change == "shallow" else 20):  # else cutting patches is most of it
            x = x + self.out(x)
        seen = self.head(x)
        return sample + (seen if self.change == "shallow" else seen.mean(1, keepdim=True))


def found(change: str) -> object:
    torch.manual_seed(0)
    spec = PolicySpec(
        (16, 8), {"image": ObservationSpec((3, 16, 16), window=False)}, flow_matching_table(1), ChunkSpec(8, 0, 4)
    )
    graph, weights = capture(Small(change).eval(), spec)
    (last,) = graph.outputs
    seen = list(graph.producers()[last].refs())[1]
    return find_tokens(backward_slice(graph, (seen,), {}), weights)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("overlap", "kernel [4, 4], stride (2, 2)"),
        ("transposed", "has not a row for each patch, in their order"),
        ("smeared", "depends on more than the patches"),
        ("masked by the picture", "depends on more than %add"),
        ("causal", "tokens come together otherwise than by attention"),
        ("written out", "tokens come together otherwise than by attention"),
        ("beside", "tokens come together otherwise than by attention"),
        ("averaged", "tokens come together otherwise than by attention"),
        ("shallow", "is 40% of its FLOPs"),
    ],
)
def test_near_misses_are_left_whole(change: str, why: str) -> None:
    said = found(change)
    assert isinstance(said, str)
    assert why in said


@pytest.mark.parametrize("change", ["", "masked"])
def test_without_the_miss_it_is_one(change: str) -> None:
    """A mask that is the same for every picture is none."""
    assert not isinstance(found(change), str)
