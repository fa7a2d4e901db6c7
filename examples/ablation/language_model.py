"""What would it bring to compute less of a language model? Layers and image tokens left out, as EfficientVLA does.

    cd examples/policies/vla
    python ../../ablation/language_model.py trained/smolvla/policy shorter -t data-set \
        --observation task=trained/smolvla/language-model

For policies of LeRobot's ``smolvla``. Nothing is trained. Each variant is written into ``shorter`` as an artifact that
``evaluate.py`` can drive; the original is there, too, as ``whole``.

**Layers:** those go whose tokens are most similar before and after, by the mean cosine over recorded calls. The expert
reads keys and values of every layer. Those of a layer that is left out are computed still, from the stream as it is
there: there is no other way. Of the last layer nothing else is computed anyway, so it is no candidate.

**Image tokens:** the first layer has all of them. What all words give one there, mean over heads, is its relevance. The
``KEY`` most relevant are kept; half of the others that are kept are the next by relevance, half are those least similar
to the ``KEY``. The expert sees what is left from the second layer on, and all tokens keep their positions. Variants
called ``even`` choose nothing: they keep every second or fourth token. Those called ``edges`` choose as SP-VLA does
(arXiv 2506.12723): half of the tokens that are kept are the most relevant ones, and half those of the other patches
whose pixels differ most from their neighbours. There edges are Canny's, and more tokens go while the robot is fast.

EfficientVLA's own action head reads one token after the last layer, and no others; and its language model is a Llama 2,
with eight times the layers (arXiv 2506.10100). ``KEY`` and the two halves are our own numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from math import isqrt
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile import compile_denoiser
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import FRACTION, load_episodes, observed, sample_calls, split_episodes
from ttscompile.calibration.compare import compare
from ttscompile.calibration.progress import Bar
from ttscompile.cli.output import print_json, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.core.spec import PolicySpec
from ttscompile.errors import CalibrationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.policies.networks import language_layers as layers
from ttscompile.policies.networks.smolvla import Expert, Prefix
from ttscompile.runtimes.random_calls import normalized

KEY = 4
"""Tokens that are kept first, by relevance alone."""

Rule = Callable[[Tensor, Tensor, Tensor, int], Tensor]
"""Of image tokens' relevance ``[B, N]``, themselves ``[B, N, width]``, how steep their patches are ``[B, N]``, and how
many are kept: which, ``[B, count]``."""


@dataclass(frozen=True)
class Row:
    """What a variant does.

    Attributes:
        layers: numbers of those that are left out.
        tokens: of the images, that are kept; None for all.
        distance: from the original, in units of what other noise changes, and its 95 % interval.
        prologue: share of the original's FLOPs before the loop.
        flops: share of its FLOPs of a call.
        ms: a call, one stream, median.
    """

    name: str
    layers: tuple[int, ...]
    tokens: int | None
    distance: float
    interval: tuple[float, float]
    prologue: float
    flops: float
    ms: float


class ShorterPrefix(Prefix):
    """A prefix without some layers, and with some of the image tokens from the second layer on.

    Gives which tokens count in the first layer, and which in the others; then keys and values of each layer.
    """

    def __init__(self, whole: Prefix, left_out: Sequence[int], kept: int | None, rule: Rule) -> None:
        nn.Module.__init__(self)
        self.channels, self.width, self.left_out, self.kept = whole.channels, whole.width, tuple(left_out), kept
        self.vision_model, self.connector, self.text_model = whole.vision_model, whole.connector, whole.text_model
        self.state_proj, self.rule = whole.state_proj, rule

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """See ``Prefix``."""
        scale = self.width**0.5
        seen = self.connector(self.vision_model(torch.stack(images, 1).flatten(0, 1))) * scale
        seen = seen.unflatten(0, (-1, len(images))).flatten(1, 2)
        words = self.text_model.embed_tokens(tokens) * scale
        x, own = torch.cat([seen, words], 1), self.state_proj(state)[:, None]
        valid, count = functional.pad(mask, (seen.shape[1], 0), value=True), seen.shape[1]
        positions, own_turns = torch.cumsum(valid, 1) - 1, layers.rotation(valid.sum(1, keepdim=True), self.channels)
        found, still = list[Tensor](), valid
        for number, layer in enumerate(self.text_model.layers):
            before, turns, seen_by = x, layers.rotation(positions, self.channels), layers.prefix_mask(still)
            x, keys, values = layer(x, turns, seen_by)
            # The state's token follows by itself, as in the original: no other token sees it.
            late, *last = layer(own, own_turns, layers.added(_and_own(still)[:, None, None]), layers.Seen(keys, values))
            found += [torch.cat(pair, 2) for pair in zip((keys, values), last, strict=True)]
            if number in self.left_out:
                x = before  # so that nobody reads what the layer does but for keys and values
            else:
                own = late
            if number == 0 and self.kept is not None and self.kept < count:
                relevant = relevance(layer.self_attn, layer.input_layernorm(before), keys, turns, seen_by, mask)
                index = self.rule(relevant, x[:, :count], steepness(images, count), self.kept)
                x, positions, still = (with_some(each, index, count) for each in (x, positions, still))
        return _and_own(valid), _and_own(still), *found


def _and_own(valid: Tensor) -> Tensor:
    """Which tokens count, ``[B, T]``, and the state's after them."""
    return functional.pad(valid, (0, 1), value=True)


class ShorterExpert(Expert):
    """The expert, which sees all tokens in the first layer and those that are left in the others."""

    def __init__(self, whole: Expert) -> None:
        nn.Module.__init__(self)
        self.config, self.layers, self.norm = whole.config, whole.layers, whole.norm
        self.action_in_proj, self.action_out_proj = whole.action_in_proj, whole.action_out_proj
        self.action_time_mlp_in, self.action_time_mlp_out = whole.action_time_mlp_in, whole.action_time_mlp_out

    def forward(self, sample: Tensor, timestep: Tensor, encoded: tuple[Tensor, ...]) -> Tensor:
        """See ``Expert``; the actions come after all tokens, whichever are left."""
        valid, still, *seen = encoded
        config, count = self.config, sample.shape[1]
        x = self.action_in_proj(sample)
        time = layers.waves(timestep, config.expert.width, *config.periods)
        x = torch.cat([x, time[:, None].expand_as(x)], 2)
        x = self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(x)))
        own = torch.arange(count, device=x.device)[None]
        own_turns = layers.rotation(own, config.expert.channels)
        turns = layers.rotation(valid.sum(-1, keepdim=True) + own, config.expert.channels)
        later = layers.added(torch.ones(count, count, dtype=torch.bool, device=x.device).tril())[None, None]
        later = later.expand(len(sample), -1, -1, -1)
        for i, layer in enumerate(self.layers):
            crossing = layers.added((still if i else valid)[:, None, None, :])
            mask = crossing if layer.crosses else torch.cat([crossing.expand(-1, -1, count, -1), later], 3)
            x = layer(x, layers.Seen(seen[2 * i], seen[2 * i + 1]), turns, own_turns, mask)
        return self.action_out_proj(self.norm(x))


def relevance(
    attention: layers.Attention, normed: Tensor, keys: Tensor, turns: layers.Rotation, seen_by: Tensor, mask: Tensor
) -> Tensor:
    """What all words together give to each image token, ``[B, images]``: of their attention, the mean over heads.

    ``normed`` are images and words ``[B, T, width]``; ``mask`` is of the words, ``[B, L]``.
    """
    words = slice(normed.shape[1] - mask.shape[1], normed.shape[1])
    queries = attention.q_norm(attention.split(attention.q_proj(normed[:, words])))
    queries = layers.rotate(queries, layers.Rotation(*(each[:, :, words] for each in turns)))
    scores = queries @ attention.for_all_heads(keys).transpose(2, 3) * attention.channels**-0.5
    given = (scores + seen_by[:, :, words]).softmax(-1).mean(1)[:, :, : words.start]
    return (given * mask[:, :, None]).sum(1)


def steepness(images: Sequence[Tensor], count: int) -> Tensor:
    """Of pictures ``[B, 3, H, W]`` the mean of Sobel's magnitude in the patch of each token, ``[B, count]``."""
    grey, side = torch.stack(list(images), 1).mean(2), isqrt(count // len(images))
    rows = grey[:, :, :-2] + 2 * grey[:, :, 1:-1] + grey[:, :, 2:]
    columns = grey[..., :-2] + 2 * grey[..., 1:-1] + grey[..., 2:]
    across, down = rows[..., 2:] - rows[..., :-2], columns[:, :, 2:] - columns[:, :, :-2]
    steep = functional.pad((across**2 + down**2).sqrt(), (1, 1, 1, 1))
    return steep.unflatten(3, (side, -1)).unflatten(2, (side, -1)).mean((3, 5)).flatten(1)


def chosen(relevant: Tensor, tokens: Tensor, _: Tensor, count: int) -> Tensor:
    """By relevance, and then the least similar to the first ones."""
    key = min(KEY, count)
    best = relevant.topk(key + (count - key) // 2, 1).indices
    unit = functional.normalize(tokens, dim=2)
    first = unit.gather(1, best[:, :key, None].expand(-1, -1, unit.shape[2]))
    far = 1 - (unit @ first.transpose(1, 2)).amax(2)
    return torch.cat([best, _best_of_others(far, best, count)], 1)


def edged(relevant: Tensor, tokens: Tensor, steep: Tensor, count: int) -> Tensor:
    """Half by relevance, and half of the others by edges."""
    best = relevant.topk(count - count // 2, 1).indices
    return torch.cat([best, _best_of_others(steep, best, count)], 1)


def _best_of_others(worth: Tensor, known: Tensor, count: int) -> Tensor:
    """Of worth ``[B, N]``, none below 0, the best beside those that are known, so that there are ``count``."""
    taken = (known[:, :, None] == torch.arange(worth.shape[1], device=worth.device)).any(1)
    return torch.where(taken, -1.0, worth).topk(count - known.shape[1], 1).indices


def even(relevant: Tensor, tokens: Tensor, _: Tensor, count: int) -> Tensor:
    """Always the same ones, evenly spaced."""
    return (torch.arange(count, device=tokens.device) * tokens.shape[1] // count)[None].expand(len(tokens), -1)


def with_some(x: Tensor, index: Tensor, count: int) -> Tensor:
    """Of the first ``count`` of ``[B, T, ...]`` those of the index, and all others."""
    wide = index if x.ndim == 2 else index[:, :, None].expand(-1, -1, x.shape[2])
    return torch.cat([x[:, :count].gather(1, wide), x[:, count:]], 1)


def shorter(module: nn.Module, left_out: Sequence[int] = (), kept: int | None = None, rule: Rule = chosen) -> Any:
    """A copy of the policy without these layers, and with so many image tokens."""
    made: Any = deepcopy(module)
    made.encoder.prefix = ShorterPrefix(made.encoder.prefix, left_out, kept, rule)
    made.denoiser = ShorterExpert(made.denoiser)
    return made


def similarities(module: nn.Module, observations: dict[str, Tensor]) -> list[float]:
    """Of each layer the mean cosine of its tokens before and after, padding left out; ``observations`` by argument."""
    encoder: Any = getattr(module, "encoder", None)
    prefix, found = getattr(encoder, "prefix", None), list[Tensor]()
    if not isinstance(prefix, Prefix):
        raise CalibrationError("expected a policy of LeRobot's smolvla: the layers of others are not known here.")

    def seen(_: nn.Module, given: tuple[Tensor, ...], made: tuple[Tensor, ...]) -> None:
        found.append(functional.cosine_similarity(given[0], made[0], dim=2))

    hooks = [layer.register_forward_hook(seen) for layer in prefix.text_model.layers]
    with torch.no_grad():
        valid = encoder(observations)[0]
    for hook in hooks:
        hook.remove()
    early, late = found[: len(hooks)], found[len(hooks) :]  # pictures and words, and then the state's token
    return [float(torch.cat(pair, 1)[valid].mean()) for pair in zip(early, late, strict=True)]


def most_similar(similar: Sequence[float], count: int) -> tuple[int, ...]:
    """Numbers of so many layers; of the last one nothing is computed that could be left out."""
    candidates = len(similar) - 1
    if not 0 <= count <= candidates:
        raise CalibrationError(f"layers: {count} of {candidates} cannot be left out; the last one is no candidate.")
    return tuple(sorted(sorted(range(candidates), key=lambda n: -similar[n])[:count]))


def recorded(spec: PolicySpec, paths: Sequence[Path], sources: Sources, most: int, seed: int) -> dict[str, Tensor]:
    """Normalised observations of some calls by argument, of episodes that nobody is judged on."""
    episodes = load_episodes(spec, paths, sources)
    numbers = split_episodes(len(episodes), FRACTION, seed).calibration
    seen = normalized(spec, observed(spec, episodes, sample_calls(episodes, numbers, most, seed)))
    return {spec.arguments[key]: torch.from_numpy(np.array(each)) for key, each in seen.items()}


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("checkpoint", type=click.Path(exists=True, path_type=Path))
@click.argument("folder", type=click.Path(path_type=Path))
@trajectories_options()
@click.option("--layers", "counts", multiple=True, default=(1, 2), help="Leave so many layers out.")
@click.option("--tokens", multiple=True, default=(64, 32), help="Keep so many image tokens; both together, too.")
@click.option("--learned", default=64, help="Calls that similarities are measured on, at most.")
@click.option("--calls", default=32, help="Calls of other episodes, to judge on, at most.")
@click.option("--seed", default=0, help="Of the division of the episodes, the calls and the noise.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def main(
    checkpoint: Path,
    folder: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    counts: Sequence[int],
    tokens: Sequence[int],
    learned: int,
    calls: int,
    seed: int,
    as_json: bool,
) -> None:
    """Measure it for the policy in CHECKPOINT; artifacts go into FOLDER."""
    module, spec = load_checkpoint_policy(checkpoint)
    similar = similarities(module, recorded(spec, trajectories, sources, learned, seed))
    made: dict[str, tuple[tuple[int, ...], int | None, Rule]] = {"whole": ((), None, chosen)}
    made |= {f"layers-{count}": (most_similar(similar, count), None, chosen) for count in counts}
    made |= {f"tokens-{kept}": ((), kept, chosen) for kept in tokens}
    made |= {f"{name}-{kept}": ((), kept, rule) for name, rule in (("even", even), ("edges", edged)) for kept in tokens}
    both = zip(counts, tokens, strict=False)
    made |= {f"layers-{count}-tokens-{kept}": (most_similar(similar, count), kept, chosen) for count, kept in both}
    for name, variant in made.items():
        compile_denoiser(module if name == "whole" else shorter(module, *variant), spec, folder / name)
    paths = [folder / name for name in made]
    with Bar(shown=True) as bar:
        how: dict[str, Any] = {"observation": sources, "calls": calls, "seed": seed, "progress": bar.tell}
        points = compare(paths[0], trajectories, paths[1:], **how).points
    prologues = [load_artifact(path).manifest.flops.prologue for path in paths]
    rows = []
    for (name, (left_out, kept, _)), point, own in zip(made.items(), points, prologues, strict=True):
        shares = own / prologues[0], point.flops / points[0].flops
        rows.append(Row(name, left_out, kept, point.distance, point.interval, *shares, point.latency_ms))
    if as_json:
        print_json({"similarities": similar, "rows": [asdict(one) for one in rows]})
    else:
        show(similar, rows)


def show(similar: Sequence[float], rows: Sequence[Row]) -> None:
    """What was found as a table, and what the words in it mean."""
    output = results_console()
    made = table("", "layers left out", "image tokens", "distance", "95 %", "prologue", "FLOPs", "ms a call")
    for one in rows:
        made.add_row(
            one.name,
            ", ".join(map(str, one.layers)) or "none",
            "all" if one.tokens is None else str(one.tokens),
            f"{one.distance:.3f}",
            "..".join(f"{each:.3f}" for each in one.interval),
            f"{one.prologue:.1%}",
            f"{one.flops:.1%}",
            f"{one.ms:.3f}",
        )
    output.print(made)
    say(
        output,
        f"Similarity of layers: {', '.join(f'{each:.3f}' for each in similar)}. Distance: between the actions and the"
        " original's for the same observation, in units of what other noise changes. Prologue and FLOPs: what is left"
        " of the original's before the loop, and of a call. All take turns, one stream, one thread.",
    )


if __name__ == "__main__":
    run(main)
