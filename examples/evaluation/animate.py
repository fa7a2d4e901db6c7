"""Draw episodes of one seed, side by side, as one small animation.

    python examples/evaluation/animate.py DIR:dense DIR -o episode.gif

A seed and its actions are the episode: it is played once more, and drawn by its environment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import click
from environments import Environment, environment_class, environment_option
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import Progress
from rollout import Episode, run_batch
from variants import first_seed_option, open_variant, run, runtime_option, threads_option

CAPTION = 40
FRAME_MS = 100
PACE = 2
"""Times real time."""
COLOURS = 48


def save_animation(
    path: Path, make: Callable[[], Environment], episodes: Sequence[Episode], labels: Sequence[str], size: int = 288
) -> None:
    """Write episodes side by side as a GIF, at twice their speed; one that ends earlier holds its last frame.

    Args:
        path: of the GIF.
        make: an environment of its own for each episode.
        episodes: at least one.
        labels: one an episode, written below it.
        size: width of each, pixels.
    """
    parts = [_pictures(make(), episode, label, size) for episode, label in zip(episodes, labels, strict=True)]
    frames = []
    for i in range(max(len(part) for part in parts)):
        now = [part[min(i, len(part) - 1)] for part in parts]
        frame = Image.new("RGB", (size * len(now), max(one.height for one in now)), "white")
        for j, one in enumerate(now):
            frame.paste(one, (j * size, 0))
        frames.append(frame)
    palette = frames[len(frames) // 2].quantize(COLOURS)  # one for all: what does not move costs nothing
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [FRAME_MS] * (len(indexed) - 1) + [20 * FRAME_MS]
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=True)


def _pictures(environment: Environment, episode: Episode, label: str, size: int) -> list[Image.Image]:
    """Of the start, of every so many actions, and of the end."""
    every = max(round(PACE * FRAME_MS / 1000 * environment.hz), 1)
    environment.reset(episode.seed)
    found = [_picture(environment, f"{label}\n0.0 s", size)]
    for step, action in enumerate(episode.actions, 1):
        environment.step(action)
        if step % every == 0 or step == len(episode.actions):
            told = f"{label}\n{step / environment.hz:.1f} s   score {environment.score:.2f}"
            found.append(_picture(environment, told, size))
    environment.close()
    return found


def _picture(environment: Environment, caption: str, size: int) -> Image.Image:
    image = Image.fromarray(environment.picture())
    height = round(size * image.height / image.width)
    canvas = Image.new("RGB", (size, height + CAPTION), "white")
    canvas.paste(image.resize((size, height), Image.Resampling.LANCZOS))
    ImageDraw.Draw(canvas).multiline_text((8, height + 4), caption, fill="black", font=ImageFont.load_default(13))
    return canvas


@click.command()
@click.argument("variants", nargs=-1, required=True, metavar="DIR[:PLAN]...")
@environment_option
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path))
@first_seed_option
@runtime_option
@threads_option
def main(
    variants: tuple[str, ...], environment: str, output: Path, first_seed: int, runtime: str, threads: int
) -> None:
    """Run one episode with each variant, on the same seed, and draw them side by side."""
    make = environment_class(environment)
    episodes: list[Episode] = []
    with Progress(console=Console(stderr=True)) as progress:
        for text in progress.track(variants, description="running episodes"):
            episodes += run_batch(make, open_variant(text, runtime, threads), [first_seed]).episodes
    save_animation(output, make, episodes, variants)
    scores = ", ".join(f"{text} {episode.score:.3f}" for text, episode in zip(variants, episodes, strict=True))
    click.echo(f"{output}: {output.stat().st_size / 1e6:.2f} MB; scores: {scores}")


if __name__ == "__main__":
    run(main)
