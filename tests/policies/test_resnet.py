"""The ResNets against those of transformers, which are written independently."""

from typing import Any

import pytest
import torch
from torch import nn
from transformers import ResNetConfig, ResNetModel

from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.policies.networks.resnet import CHANNELS, DEPTHS, SHRINKS, resnet


@pytest.mark.parametrize("name", DEPTHS)
def test_another_implementation_gives_the_same(name: str) -> None:
    """On an odd size, with statistics of batch norm that are not the initial ones."""
    torch.manual_seed(0)
    network = resnet(3, nn.BatchNorm2d, name).eval()
    for key, value in network.state_dict().items():
        if "running" in key:
            value.uniform_(0.5, 1.5)
    settings: dict[str, Any] = {
        "hidden_sizes": [64, 128, 256, 512],
        "depths": list(DEPTHS[name]),
        "layer_type": "basic",
    }
    other = ResNetModel(ResNetConfig(embedding_size=64, **settings)).eval()
    # Both keep their weights in the order of the computation, but for the shortcuts: here last, and there first.
    weights = network.state_dict()
    ours, theirs = (
        sorted(keys, key=lambda key: shortcut in key)
        for keys, shortcut in ((weights, "downsample"), (other.state_dict(), "shortcut"))
    )
    other.load_state_dict({their: weights[our] for their, our in zip(theirs, ours, strict=True)})
    images = torch.randn(2, 3, 70, 45)
    with torch.inference_mode(), Counted() as counted:
        found = network(images)
    with torch.inference_mode():
        expected = other(images).last_hidden_state
    assert found.shape == (2, CHANNELS, -(-70 // SHRINKS), -(-45 // SHRINKS))
    assert_equal_but_for_rounding(found, expected, counted.terms)
