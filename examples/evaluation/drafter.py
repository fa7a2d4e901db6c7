"""The small network that ``drafted.py`` drafts steps with, and how it learns from dense calls."""

from __future__ import annotations

import torch
from falcon import output_of
from torch import Tensor, nn

from ttscompile.calibration.calls import Calls
from ttscompile.calibration.runner import Runner
from ttscompile.runtimes.reference.sampler import Carried

WIDTH, HEADS, BATCH, RATE = 64, 4, 256, 2e-3
"""Of the drafter: channels and heads of its one layer, samples of an update, and the learning rate at first."""


class Drafter(nn.Module):
    """One layer of a transformer over the tokens of a chunk, which knows the step and the observation.

    Args:
        shape: T and D.
        steps: of the loop.
        features: numbers of the observation.
    """

    def __init__(self, shape: tuple[int, int], steps: int, features: int) -> None:
        super().__init__()
        horizon, channels = shape
        self.embed = nn.Linear(2 * channels, WIDTH)
        self.place = nn.Parameter(torch.zeros(horizon, WIDTH))
        self.time = nn.Embedding(steps, WIDTH)
        self.observe = nn.Linear(features, WIDTH)
        self.layer = nn.TransformerEncoderLayer(WIDTH, HEADS, 2 * WIDTH, 0.0, batch_first=True, norm_first=True)
        self.head = nn.Linear(WIDTH, channels)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, sample: Tensor, k: Tensor, last: Tensor, features: Tensor) -> Tensor:
        """A prediction ``[N, T, D]``: the network's last one, and what has changed."""
        hidden = self.embed(torch.cat([sample, last], 2)) + self.place
        hidden = hidden + (self.time(k) + self.observe(features))[:, None]
        changed: Tensor = self.head(self.layer(hidden))
        return last + changed


@torch.no_grad()
def predictions(runner: Runner, calls: Calls) -> tuple[Tensor, Tensor]:
    """Samples and predictions at each step of dense calls, ``[K, N, T, D]`` both."""
    model, sampler, carried = runner.model, runner.model.sampler, runner.model.sampler.begin(calls.initial)
    samples, found = list[Tensor](), list[Tensor]()
    for k in range(model.steps):
        samples.append(carried.sample)
        found.append(output_of(model, carried.sample, k, calls.contexts))
        carried = Carried(*sampler.advance(carried, found[-1], None if calls.noise is None else calls.noise[k], k))
    return torch.stack(samples), torch.stack(found)


def trained(runner: Runner, calls: Calls, ahead: int, updates: int, seed: int) -> Drafter:
    """A drafter that learned from dense calls what the network says up to so many steps after its last prediction."""
    samples, found = predictions(runner, calls)
    features = runner.model.condition(calls.contexts)
    steps, count = samples.shape[:2]
    torch.manual_seed(seed)
    drafter = Drafter((samples.shape[2], samples.shape[3]), steps, features.shape[1])
    optimizer = torch.optim.AdamW(drafter.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(1, updates))
    for _ in range(updates):
        k, call = torch.randint(1, steps, (BATCH,)), torch.randint(count, (BATCH,))
        before = (k - torch.randint(1, ahead + 1, (BATCH,))).clamp(min=0)
        wrong = drafter(samples[k, call], k, found[before, call], features[call]) - found[k, call]
        loss = wrong.square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return drafter.eval()
