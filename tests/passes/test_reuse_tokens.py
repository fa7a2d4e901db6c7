"""A tower that is a vision transformer has a form for some of its tokens, and so has a scene that reads a sequence."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from tests.families import cameras, scenes
from tests.literal_tokens import LiteralTokens
from ttscompile.capture.export import capture
from ttscompile.core.coercion import Arrays
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType, backward_slice
from ttscompile.ir.pieces import INDEX, PIXELS, PLACES, ROWS, kept_inputs
from ttscompile.ir.program import Program
from ttscompile.ir.tokens import TokenStream, find_sequence, find_tokens, words_of
from ttscompile.ir.verify import verify
from ttscompile.passes.reuse_tokens import ReuseTokens, _pixels_graph, for_tokens
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
    kept = {name: torch.full(kind.at(1), torch.nan) for name, kind in kept_inputs(part).items()}
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
        ("beside", "tokens come together otherwise than by attention"),
        ("averaged", "tokens come together otherwise than by attention"),
        ("shallow", "is 40% of its FLOPs"),
    ],
)
def test_near_misses_are_left_whole(change: str, why: str) -> None:
    said = found(change)
    assert isinstance(said, str)
    assert why in said


@pytest.mark.parametrize("change", ["", "masked", "written out"])
def test_without_the_miss_it_is_one(change: str) -> None:
    """A mask that is the same for every picture is none; attention may be written as two products."""
    assert not isinstance(found(change), str)


SEEN, TOLD, WIDE = 16, 4, 8


class Told(nn.Module):
    """A language model of one layer that reads rows of a picture, and words; one thing may be otherwise."""

    def __init__(self, change: str) -> None:
        super().__init__()
        self.change = change
        self.words, self.place = nn.Embedding(16, WIDE), nn.Parameter(torch.randn(SEEN + TOLD, WIDE))
        self.qkv, self.out, self.before = nn.Linear(WIDE, 3 * WIDE), nn.Linear(WIDE, WIDE), nn.Linear(WIDE, 99 * WIDE)
        self.back = nn.Linear(99 * WIDE, WIDE)

    def forward(self, sample: Tensor, timestep: Tensor, rows: Tensor, words: Tensor, other: Tensor) -> Tensor:
        change = self.change
        if change == "short":
            rows = rows[:, :8]
        if change == "late":
            rows = self.back(self.before(rows))
        told = self.words(words)
        x = torch.cat([rows, told], 1)
        if change == "prompted":
            x = torch.cat([self.place[None, :2].expand(len(rows), -1, -1), rows, told], 1)
        if change == "added":
            x = rows + told.mean(1, keepdim=True)
        attended = self.attended(x, words)
        x = x + self.out(attended)
        if change == "averaged":
            x = x + self.back(self.before(x.mean(1, keepdim=True).expand(x.shape)))
        if change in ("seen later", "deeper"):
            x = x + functional.pad(rows if change == "deeper" else other, (0, 0, 0, TOLD))
        for _ in range(20):
            x = x + self.out(x) / 8
        if change == "handed on":
            x = torch.cat([x, 2 * rows], 1)
        return sample + x.sum(1, keepdim=True)

    def attended(self, x: Tensor, words: Tensor) -> Tensor:
        """By two heads of queries."""
        change, count = self.change, x.shape[1]
        q, k, v = self.qkv(functional.layer_norm(x, (WIDE,))).split(WIDE, -1)
        heads = [each.unflatten(-1, (2, WIDE // 2)).transpose(1, 2) for each in (q, k, v)]
        shown = functional.pad(words > 0, (count - TOLD, 0), value=True)[:, None, None]
        if change == "turned":
            turns = torch.arange(count)[:, None] / torch.arange(1, 3)
            for i in range(2):
                one, other = heads[i].chunk(2, -1)
                turned = [one * turns.cos() - other * turns.sin(), other * turns.cos() + one * turns.sin()]
                heads[i] = torch.cat(turned, -1)
        if change in ("grouped", "spread"):
            heads[1:] = [each[:, :1] for each in heads[1:]]
        if change == "grouped":
            heads[1:] = [each.repeat_interleave(2, 1) for each in heads[1:]]
        if change == "spread":
            heads[1:] = [each[:, :, None].expand(len(x), 1, 2, count, 4).flatten(1, 2) for each in heads[1:]]
        q, k, v = heads
        if change in ("written out", "over queries", "turned", "spread"):
            scores = torch.where(shown, q @ k.transpose(2, 3), -1e9)
            mixed = scores.softmax(2 if change == "over queries" else 3) @ v
        else:
            mask = shown & torch.ones(count, count, dtype=torch.bool).tril() if change == "masked" else None
            mixed = functional.scaled_dot_product_attention(q, k, v, mask, is_causal=change == "causal")
        return mixed.transpose(1, 2).flatten(2)


@cache
def sequence(change: str) -> tuple[Graph, Arrays]:
    """What stands for a scene: of what is read, all rows together."""
    torch.manual_seed(0)
    observations = {key: ObservationSpec((SEEN, WIDE), window=False) for key in ("rows", "other")}
    observations["words"] = ObservationSpec((TOLD,), dtype="int64", window=False, bounds=(0, 15))
    spec = PolicySpec((16, WIDE), observations, flow_matching_table(1), ChunkSpec(WIDE, 0, 4))
    graph, weights = capture(Told(change).eval(), spec)
    (last,) = graph.outputs
    summed = graph.producers()[list(graph.producers()[last].refs())[1]]
    seen = tuple(summed.refs())
    if change == "handed on":  # two results
        seen = tuple(graph.producers()[seen[0]].refs())
    return backward_slice(graph, seen, {}), weights


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("short", "has 12 tokens, fewer than 16"),
        ("late", r"what makes %cat is \d\d% of its FLOPs"),
        ("added", "nothing puts what towers give, and words, one after the other"),
        ("averaged", r"at %mean \(aten.mean.dim\) tokens come together otherwise than by attention"),
        ("handed on", "what it gives depends on %rows otherwise than by %cat"),
        ("seen later", "what it gives depends on %other otherwise than by %cat"),
        ("over queries", r"at %softmax \(aten.softmax.int\) tokens come together otherwise than by attention"),
        ("causal", r"at %scaled_dot_product_attention \(.*\) tokens come together otherwise than by attention"),
    ],
)
def test_scenes_that_nearly_read_a_sequence_are_left_whole(change: str, why: str) -> None:
    said = find_sequence(sequence(change)[0])
    assert isinstance(said, str)
    assert re.search(why, said)


READ = ("", "masked", "written out", "turned", "grouped", "spread", "prompted", "deeper")
"""Attention as one operation or three, of as many keys as queries or of half as many, with masks that words decide. A
row of a picture may be read once more in a later layer, as Qwen3-VL does: it changed if the row of the sequence did."""


@pytest.mark.parametrize("change", READ)
def test_some_rows_of_a_sequence_give_what_they_literally_give(change: str) -> None:
    graph, weights = sequence(change)
    stream = find_sequence(graph)
    assert isinstance(stream, TokenStream)
    tokens = SEEN + TOLD + 2 * (change == "prompted")
    assert (stream.pixels == stream.entry, stream.tokens, stream.fixed) == (True, tokens, 0)
    part, literal, rng = for_tokens(graph, stream), LiteralTokens(graph, weights, stream), np.random.default_rng(0)
    own = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    kept = {name: torch.full(kind.at(1), torch.nan) for name, kind in kept_inputs(part).items()}
    assert all(kind.shape[0] == tokens for kind in kept_inputs(part).values())
    for computed in (range(tokens), [0, 3, 16], [19], range(tokens), [5, 7, 11, 18]):
        seen: dict[str, Any] = {"rows": rng.standard_normal((1, SEEN, WIDE), np.float32)}
        seen["words"] = rng.integers(0, 3, (1, TOLD))
        given = {name: torch.from_numpy(value) for name, value in seen.items()}
        (cut,) = evaluate(cutting := _pixels_graph(graph, stream), own, {name: given[name] for name in cutting.inputs})
        assert cut.shape == (1, 1, tokens, WIDE)
        index = torch.tensor(list(computed))
        feed = {PIXELS: cut, INDEX: index, PLACES: index.repeat(2), ROWS: torch.arange(len(index)).repeat(2)}
        feed |= {name: given[name] for name in part.inputs if name in given}
        value, *renewed = evaluate(part, own, {**feed, **kept})
        kept = dict(zip(kept, renewed, strict=True))
        np.testing.assert_allclose(value, literal(seen, list(computed))[0], rtol=0, atol=1e-5)
    whole = evaluate(graph, own, {name: given[name] for name in graph.inputs})[0]
    assert (whole - value).abs().max() > 1e-3, "tokens that were not computed keep what they gave"


@pytest.mark.parametrize(("change", "words"), [("", range(16, 20)), ("prompted", [0, 1, *range(18, 22)])])
def test_words_are_the_rows_that_no_picture_changes(change: str, words: Sequence[int]) -> None:
    graph, weights = sequence(change)
    stream = find_sequence(graph)
    assert isinstance(stream, TokenStream)
    assert words_of(_pixels_graph(graph, stream), weights) == tuple(words)


@cache
def with_scene() -> Program:
    """Its towers have no tokens."""
    return transform(*scenes.policy("last", tower=scenes.Grid))


def test_a_scene_has_a_form_for_some_of_its_tokens() -> None:
    program = with_scene()
    pieces = program.pieces
    scene, pixels, part = pieces.scene, *(pieces.tokens[name] for name in ("pixels_scene", "tokens_scene"))
    assert scene is not None
    assert set(pieces.tokens) == {"pixels_scene", "tokens_scene"}
    assert pixels.inputs == scene.inputs
    assert pixels.types()[PIXELS] == TensorType((Batch(), 1, 80, scenes.WIDTH), "float32")
    assert part.inputs[PIXELS] == TensorType((1, 1, 80, scenes.WIDTH), "float32")
    assert part.inputs["tokens"] == TensorType((1, cameras.WORDS), "int64"), "which of the words are read"
    assert part.outputs[: len(scene.outputs)] == scene.outputs
    bare = replace(program, pieces=replace(pieces, tokens={}))
    made = ReuseTokens()(bare)
    kept = sum(4 * np.prod(kind.at(1)) for kind in kept_inputs(part).values())
    assert made.notes == (
        "frame_00: the whole frame is the unit: it is convolutional: %conv2d_1 convolves features",
        f"scene: 80 tokens, of which {kept / 1e6:.1f} MB are kept",
    )
    assert made.program.pieces.tokens == pieces.tokens


def test_a_scene_of_few_tokens_is_computed_whole() -> None:
    program = transform(*scenes.policy("last"))
    assert program.pieces.tokens == {}
    assert ReuseTokens()(program).notes[-1] == "scene: the whole scene is the unit: %cat has 10 tokens, fewer than 16"


@pytest.mark.parametrize("place", [0, -1])
def test_a_form_of_a_scene_that_gives_something_else_is_refused(place: int) -> None:
    """One of its rows is another's, or one of its results."""
    program = with_scene()
    part = program.pieces.tokens["tokens_scene"]
    kind = part.types()[part.outputs[0]]
    nodes = [node for node in part.nodes if node.op == "aten.linear.default"]
    chosen = nodes[place]
    wrong = Node("wrong", "aten.neg.default", (Ref(chosen.name),), (), (chosen.type,))
    assert kind.dtype == "float32"
    at = part.nodes.index(chosen) + 1
    later = tuple(node.renamed(lambda name: "wrong" if name == chosen.name else name) for node in part.nodes[at:])
    broken = replace(part, nodes=(*part.nodes[:at], wrong, *later))
    pieces = replace(program.pieces, tokens={**program.pieces.tokens, "tokens_scene": broken})
    verify(replace(program, pieces=pieces))
    with pytest.raises(PassError, match=r"ReuseTokens: %getitem_\d+ of all tokens is not what the tower gives"):
        ReuseTokens().ensures(replace(program, pieces=pieces))
    ReuseTokens().ensures(program)
