"""Layers and image tokens of a language model that are left out, on a tiny smolvla with random weights."""

from typing import Any
from unittest.mock import patch

import language_model as ablation
import pytest
import torch
from torch import Tensor, nn

from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.policies.networks import language_layers as layers
from ttscompile.policies.networks.siglip import SiglipConfig
from ttscompile.policies.networks.smolvla import Expert, Prefix, SmolVLA, SmolVLAConfig, expert_of

IMAGES, WORDS = torch.rand(2, 3, 3, 16, 16, generator=torch.Generator().manual_seed(1)) * 2 - 1, torch.arange(5)
GIVEN: Any = list(IMAGES), WORDS.expand(3, -1), WORDS[None] < torch.tensor([[5], [3], [2]]), torch.eye(3, 6)
"""Two cameras of 16 tokens each, five words at most, and the state; of three streams."""


class Encoder(nn.Module):
    def __init__(self, prefix: Prefix) -> None:
        super().__init__()
        self.prefix = prefix

    def forward(self, given: Any) -> tuple[Tensor, ...]:
        return self.prefix(*given)


@pytest.fixture
def policy() -> Any:
    torch.manual_seed(0)
    vision = SiglipConfig(hidden_size=8, intermediate_size=12, num_hidden_layers=1, num_attention_heads=2, patch_size=4)
    text, crosses = layers.LanguageConfig(16, 24, 4, heads=4, groups=2, channels=4), (False, True, False, True)
    config = SmolVLAConfig(vision, text, 20, 1, (16, 16), expert_of(text, 0.75), crosses, 6, 4, (4e-3, 4.0))
    network = SmolVLA(config).requires_grad_(False)
    for name, weight in network.named_parameters():
        nn.init.ones_(weight) if "norm" in name else nn.init.normal_(weight, std=0.3)
    return EncodedDenoiser(Encoder(Prefix(network)), Expert(network)).eval()


def answer(policy: Any, encoded: Any = None) -> Any:
    return policy.denoiser(torch.eye(6, 4).expand(3, -1, -1), torch.full((3,), 0.7), encoded or policy.encoder(GIVEN))


def test_with_all_layers_and_tokens_it_is_the_original(policy: Any) -> None:
    for kept in (None, 32):
        valid, _, *found = ablation.shorter(policy, (), kept).encoder(GIVEN)
        torch.testing.assert_close((valid, *found), policy.encoder(GIVEN))  # whose state goes through layers alone
    torch.testing.assert_close(answer(ablation.shorter(policy)), answer(policy))


def test_masks_are_as_large_as_the_originals(policy: Any) -> None:
    """Artifacts whose constants of one name differ are refused as those of two checkpoints."""
    with patch.object(layers, "prefix_mask", wraps=layers.prefix_mask) as made:
        policy.encoder(GIVEN), ablation.shorter(policy, (1,)).encoder(GIVEN)
    assert {tuple(call.args[0].shape) for call in made.call_args_list} == {(3, 37)}  # the state is none of these


def test_a_layer_that_changes_nothing_goes_first_and_is_not_missed(policy: Any) -> None:
    idle = policy.encoder.prefix.text_model.layers[1]
    nn.init.zeros_(idle.self_attn.o_proj.weight), nn.init.zeros_(idle.mlp.down_proj.weight)
    other: Any = GIVEN[0], GIVEN[1] * GIVEN[2], *GIVEN[2:]  # with other padding
    similar, padded = (ablation.similarities(policy, one) for one in (GIVEN, other))
    assert similar[1] == pytest.approx(1) and max(similar[0], similar[2]) < 0.999 and padded == pytest.approx(similar)
    torch.testing.assert_close(answer(ablation.shorter(policy, (1,))), answer(policy))
    assert (answer(ablation.shorter(policy, (0,))) - answer(policy)).abs().max() > 1e-3
    assert ablation.most_similar(similar, 1) == (1,) and ablation.most_similar([0.1, 0.3, 0.2, 1.0], 2) == (1, 2)


def test_kept_are_those_with_most_attention_and_those_unlike_them() -> None:
    attention = layers.Attention(layers.LanguageConfig(2, 2, 1, heads=1, groups=1, channels=2))
    nn.init.eye_(attention.q_proj.weight)
    keys, normed, tokens = torch.zeros(1, 1, 10, 2), torch.zeros(1, 10, 2), torch.ones(1, 8, 2)
    keys[..., :8, 1] = torch.tensor([0.0, 0.9, 0.1, 0.8, 0.7, 0.2, 0.6, 0.3])
    normed[0, 8:10, 1] = torch.tensor([1.0, -50.0])  # a word, and padding that looks elsewhere
    still = layers.Rotation(torch.ones(1, 1, 10, 1), torch.zeros(1, 1, 10, 1))
    mask, seen_by = torch.tensor([[True, False]]), torch.zeros(1, 1, 10, 10)
    relevant = ablation.relevance(attention, normed, keys, still, seen_by, mask)
    torch.testing.assert_close(relevant[0], (keys[0, 0, :, 1] / 2**0.5).softmax(0)[:8])
    tokens[0, [2, 7]] = torch.tensor([[1.0, -1.0], [-1.0, -1.0]])
    steep = torch.tensor([[0.1, 0.9, 0.4, 0.2, 0.0, 0.3, 0.0, 0.8]])
    assert ablation.chosen(relevant, tokens, steep, 6).tolist() == [[1, 3, 4, 6, 7, 2]]
    assert ablation.edged(relevant, tokens, steep, 5).tolist() == [[1, 3, 4, 7, 2]]
    assert ablation.even(relevant, tokens, steep, 4).tolist() == [[0, 2, 4, 6]]


def test_patches_with_edges_are_steep_and_in_the_order_of_their_tokens() -> None:
    """A ramp across is as steep everywhere; an edge is in the patch that it is in, whichever way it goes."""
    ramp, edge = (torch.arange(16.0) / 8).expand(2, 3, 16, 16), torch.zeros(2, 3, 16, 16)
    edge[0, :, 4:8, 6:], edge[1, :, 9:, 8:12] = 1, 1
    steep = ablation.steepness([ramp, edge], 32)
    assert steep.shape == (2, 32)
    torch.testing.assert_close(steep[:, [5, 6, 9, 10]], torch.ones(2, 4))  # 8 times the difference of neighbours
    assert steep[0, 16:].argmax() == 5 and steep[1, 16:].argmax() in (8 + 2, 12 + 2)
    assert steep[0, 28:].tolist() == [0.0] * 4  # far from it


def test_what_is_left_out_is_as_if_nobody_saw_it(policy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    index = torch.tensor([[3, 30, 7], [0, 1, 2], [31, 16, 15]])
    valid, still, *found = (short := ablation.shorter(policy, (2,), 3, lambda *_: index)).encoder(GIVEN)
    assert [one.shape[2] for one in found] == [38, 38, *[9] * 6]
    masked = valid & torch.ones_like(valid).index_fill(1, torch.arange(32), 0).scatter(1, index, 1)
    # The same with all tokens at their positions, and those masked from the second layer on.
    instead = {torch.bool: masked[:, :-1], torch.int64: valid[:, :-1].cumsum(1) - 1}
    monkeypatch.setattr(ablation, "with_some", lambda x, index, count: instead.get(x.dtype, x))
    torch.testing.assert_close(answer(short, (valid, still, *found)), answer(short, short.encoder(GIVEN)))
    with patch.object(layers, "rotation", wraps=layers.rotation) as turned:
        answer(short, (valid, still, *found))
    assert torch.equal(turned.call_args.args[0][:, 0], valid.sum(1))  # where actions are does not change
