"""Ways to choose which tokens of a new frame are computed, and what each does to what is executed.

A token that is not computed keeps its rows. To first order this changes the actions by their gradients in these rows,
times the differences of the rows: its *effect*. Of a call it is known only when everything has been computed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from kept_tokens import Kept, TokenPolicy
from torch import Tensor, nn

from ttscompile.calibration.calls import draw_noise, observed
from ttscompile.runtimes.random_calls import Observation, normalized
from ttscompile.trajectories.episodes import Episode

CALLS = 3
"""Consecutive calls of an episode: the first one computes all."""
PROBES = 4
"""Random directions in which the effects on the actions are looked at."""
REACH = 2
"""A patch is looked for so many patches away."""
HIDDEN, UPDATES = 16, 600
"""Of the head."""
LEAST = 1e-3
"""Difference of a patch that counts as none."""


@dataclass(frozen=True)
class Seen:
    """A frame, and what was kept of those before it, of several streams.

    Attributes:
        new, old: patches ``[N, patches, C, height, width]``; old are those that tokens were last computed for.
        rows: of the frame, as the tower reads them.
    """

    new: Tensor
    old: Tensor
    rows: Tensor
    kept: Kept

    @property
    def differences(self) -> Tensor:
        """Mean absolute ones, ``[N, patches]``."""
        return (self.new - self.old).abs().mean((2, 3, 4))


Effect = Callable[[Seen], Tensor]
"""What keeping each patch's token does to the actions of the call, ``[N, patches]``."""


class Head(nn.Module):
    """Says of each patch how large the effect is: by what its neighbours and itself were, and are, and by its place."""

    def __init__(self, grid: tuple[int, int], features: int) -> None:
        super().__init__()
        self.grid, self.weight = grid, nn.Parameter(torch.ones(1))
        self.near = nn.Conv2d(features, HIDDEN, 3, padding=1)
        self.place = nn.Parameter(torch.zeros(HIDDEN, *grid))
        self.out = nn.Conv2d(HIDDEN, 1, 1)
        nn.init.zeros_(self.out.weight)

    def forward(self, features: Tensor, prior: Tensor) -> Tensor:
        """Logarithms, but for what is common to all, from features ``[N, F, patches]`` and a first guess."""
        found = self.out(torch.relu(self.near(features.unflatten(2, self.grid)) + self.place))
        return self.weight * prior + found.flatten(1)

    @property
    def flops(self) -> int:
        """Of a frame."""
        return 2 * self.grid[0] * self.grid[1] * HIDDEN * (9 * self.near.in_channels + 1)


def features(seen: Seen) -> Tensor:
    """What is known of each patch without computing anything, ``[N, F, patches]``."""
    difference, colours = seen.new - seen.old, [seen.new.mean((3, 4)), seen.old.mean((3, 4))]
    told = [(seen.differences + LEAST).log(), (difference.abs().amax((2, 3, 4)) + LEAST).log()]
    told += [one.std((3, 4)).mean(2) for one in (seen.new, seen.old)]
    told += [(one.amax(2) - one.amin(2)).mean((2, 3)) for one in (seen.new, seen.old)]
    found = torch.cat([torch.stack(told, 2), difference.mean((3, 4)), *colours], 2).transpose(1, 2)
    return torch.cat([found, found[:, :2].mean(2, keepdim=True).expand_as(found[:, :2])], 1)


class Orders:
    """What is learned of the effects in calls: the importance of each patch, and a head."""

    def __init__(self, grid: tuple[int, int], seen: Sequence[Tensor], differences: Tensor, effects: Tensor, seed: int):
        squares = differences**2
        self.importance = (effects**2).mean(0) / (squares.mean(0) + 0.01 * squares.mean())
        self.importance = self.importance.sqrt()
        given = torch.cat(list(seen))
        self._mean, self._deviation = given.mean((0, 2), keepdim=True), given.std((0, 2), keepdim=True) + LEAST
        torch.manual_seed(seed)
        self.head = Head(grid, given.shape[1])
        self._train((given - self._mean) / self._deviation, self.prior(differences), effects)

    def prior(self, differences: Tensor) -> Tensor:
        """Logarithm of what the importance alone says."""
        return (differences + LEAST).log() + (self.importance + LEAST * self.importance.mean()).log()

    def by_head(self, seen: Seen) -> Tensor:
        """What the head says of frames."""
        with torch.no_grad():
            return self.head((features(seen) - self._mean) / self._deviation, self.prior(seen.differences))

    def _train(self, given: Tensor, prior: Tensor, effects: Tensor) -> None:
        """Each patch's share of the effects of its frame is to be what the head says; a fifth of the calls say when to
        stop."""
        shares = effects / effects.sum(1, keepdim=True).clamp(min=1e-12)
        others, own = torch.arange(len(given)).tensor_split([len(given) // 5])
        optimizer = torch.optim.AdamW(self.head.parameters(), lr=3e-3, weight_decay=0.1)

        def loss(of: Tensor) -> Tensor:
            return -(shares[of] * self.head(given[of], prior[of]).log_softmax(1)).sum(1).mean()

        best, state = np.inf, self.head.state_dict()
        for update in range(UPDATES):
            if update % 20 == 0 and len(others):
                with torch.no_grad():
                    found = float(loss(others))
                if found < best:
                    best, state = found, {name: one.clone() for name, one in self.head.state_dict().items()}
            optimizer.zero_grad()
            loss(own[torch.randint(len(own), (64,))]).backward()
            optimizer.step()
        self.head.load_state_dict(state)


class Chains:
    """Consecutive calls of episodes, and what the policy executes in them with all tokens."""

    def __init__(self, policy: TokenPolicy, camera: int, episodes: Sequence[tuple[Episode, int]], seed: int) -> None:
        self.policy, self.camera, self._tower = policy, camera, policy.tower
        spec, count = policy.spec, len(episodes)
        recorded = [episode for episode, _ in episodes]
        places = [[(i, first + c) for i, (_, first) in enumerate(episodes)] for c in range(CALLS)]
        self.obs: list[Observation] = [normalized(spec, observed(spec, recorded, one)) for one in places]
        self.noise = [draw_noise(spec, count, (seed, 13, c)) for c in range(CALLS)]
        self.lanes = policy.lanes(self.obs[0])
        self.rows = [policy.rows(obs) for obs in self.obs]
        with torch.no_grad():
            self.whole = [self._tower.whole(rows) for rows in self.rows]
            self.actions = [self._executed(c, self.whole[c][0], self.noise[c]) for c in range(CALLS)]

    def other_noise(self, seed: int) -> float:
        """How far other noise takes the actions."""
        with torch.no_grad():
            noise = [draw_noise(self.policy.spec, len(rows), (seed, 14, c)) for c, rows in enumerate(self.actions)]
            others = [self._executed(c, self.whole[c][0], noise[c]) for c in range(CALLS)]
        return float(torch.stack([(a - b).abs().mean() for a, b in zip(self.actions, others, strict=True)]).mean())

    def effects(self, seed: int) -> tuple[list[Tensor], Tensor, Tensor]:
        """Features, differences and effects of the camera's last frames, each after one that was computed whole."""
        told = list[Tensor](), list[Tensor](), list[Tensor]()
        generator = torch.Generator().manual_seed(seed)
        for c in range(1, CALLS):
            at = [self.lanes[self.camera][-1], self.lanes[self.camera][-2:][0]]
            before = self.rows[c][at[1]] if len(self.lanes[self.camera]) > 1 else self.rows[c - 1][at[0]]
            with torch.no_grad():
                kept = self._tower.whole(before)[1]
            seen = self._seen(self.rows[c][at[0]], self._tower.patches(before), kept)
            effect = self._effect(seen, c, at[0], generator)
            for into, one in zip(told, (features(seen), seen.differences, effect), strict=True):
                into.append(one)
        return told[0], torch.cat(told[1]), torch.cat(told[2])

    def errors(self, way: str, size: int, orders: Orders, seed: int) -> npt.NDArray[np.float64]:
        """Mean absolute errors of the executed actions, ``[N, CALLS - 1]``."""
        tower, found, generator = self._tower, list[Tensor](), torch.Generator().manual_seed(seed)
        kept: Kept = {}
        old = torch.zeros(0)
        for c in range(CALLS):
            given = [one.clone() for one in self.whole[c][0]]
            for number, at in enumerate(self.lanes[self.camera]):
                if c == 0 and number == 0:
                    kept = {name: value[at] for name, value in self.whole[c][1].items()}
                    old = tower.patches(self.rows[c][at])
                    continue
                seen = self._seen(self.rows[c][at], old, kept)
                score = self._score(way, seen, orders, generator, partial(self._effect, c=c, at=at))
                chosen = torch.zeros(score.shape).scatter(1, score.topk(size, 1).indices, 1.0)
                mix, start = self._sources(way, seen, chosen)
                with torch.no_grad():
                    values, kept = tower.some(seen.rows, mix, start)
                for into, one in zip(given, values, strict=True):
                    into[at] = one
                old = torch.where(chosen[:, :, None, None, None] > 0, seen.new, old)
            if c:
                with torch.no_grad():
                    off = self._executed(c, given, self.noise[c]) - self.actions[c]
                found.append(off.abs().mean((1, 2)))
        return torch.stack(found, 1).double().numpy()

    def _seen(self, rows: Tensor, old: Tensor, kept: Kept) -> Seen:
        return Seen(self._tower.patches(rows), old, rows, kept)

    def _executed(self, c: int, given: Sequence[Tensor], noise: tuple[Tensor, Tensor | None]) -> Tensor:
        return self.policy.executed(self.obs[c], given, noise)

    def _score(self, way: str, seen: Seen, orders: Orders, generator: torch.Generator, effect: Effect) -> Tensor:
        """What tokens are ordered by, ``[N, patches]``."""
        if way == "chance":
            return torch.rand(seen.differences.shape, generator=generator)
        if way == "head":
            return orders.by_head(seen)
        if way == "effect":
            return effect(seen)
        return seen.differences * (1.0 if way in ("difference", "similar") else orders.importance)

    def _sources(self, way: str, seen: Seen, chosen: Tensor) -> tuple[Tensor, Kept]:
        """Whose rows of this frame each token has (``MaskedTower.some``), and what counts as kept."""
        fixed, count = self._tower.fixed, chosen.shape[1]
        mix, kept = torch.eye(count).expand(len(chosen), -1, -1) * chosen[:, :, None], seen.kept
        down, across = (torch.arange(size, dtype=torch.float32) for size in self._tower.grid)
        places = torch.cartesian_prod(down, across)
        away = torch.cdist(places, places, p=float("inf"))
        if way == "found":
            apart = _apart(seen.new, seen.old).masked_fill(away > REACH, np.inf)
            least, where = apart.min(2)
            own = torch.arange(count).expand_as(where)
            kept = self._tower.moved(kept, torch.where(least < 0.8 * seen.differences, where, own))
        if way in ("similar", "merged"):
            apart = _apart(seen.new, seen.new).masked_fill(chosen[:, None] == 0, np.inf)
            least, where = apart.min(2)
            other = (least < seen.differences) & (chosen == 0)
            mix = mix + nn.functional.one_hot(where, count) * other[:, :, None]
        whole = torch.eye(fixed + count).repeat(len(chosen), 1, 1)
        whole[:, fixed:, fixed:] = mix
        return whole, kept

    def _effect(self, seen: Seen, c: int, at: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The effects of frames in call c whose numbers among its rows are ``at``."""
        tower, generator = self._tower, generator or torch.Generator().manual_seed(c)
        mask = torch.ones(len(at), tower.tokens, requires_grad=True)
        values, _ = tower.some(seen.rows, torch.diag_embed(mask), seen.kept)
        given = [one.index_put((at,), new) for one, new in zip(self.whole[c][0], values, strict=True)]
        executed, found = self._executed(c, given, self.noise[c]), torch.zeros(mask.shape)
        for _ in range(PROBES):
            along = (executed * torch.randn(executed.shape, generator=generator)).sum()
            found += torch.autograd.grad(along, mask, retain_graph=True)[0] ** 2 / PROBES
        return found[:, tower.fixed :].sqrt()


def _apart(one: Tensor, other: Tensor) -> Tensor:
    """Mean absolute differences of all pairs of patches, ``[N, patches, patches]``."""
    return torch.cdist(one.flatten(2), other.flatten(2), p=1) / one[0, 0].numel()
