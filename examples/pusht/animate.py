"""Draw episodes of Push-T, side by side, as one small animation.

python examples/pusht/animate.py build/pusht/compiled:dense build/pusht/compiled -o build/pusht/episode.gif
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
import gymnasium
import numpy as np
from environment import Float64Array, place
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import Progress
from rollout import Episode, run_batch
from variants import first_seed_option, open_variant, run, runtime_option, threads_option

NATIVE = 512
"""Pixels of gym-pusht's own drawing: one a unit of the world."""
CAPTION = 40
FRAME_MS = 100
COLOURS = 48
TARGET_COLOUR = (214, 40, 40)


class Scene:
    """Draws states with gym-pusht's own renderer."""

    def __init__(self) -> None:
        self._gym = gymnasium.make(
            "gym_pusht/PushT-v0",
            obs_type="state",
            render_mode="rgb_array",
            visualization_width=NATIVE,
            visualization_height=NATIVE,
            disable_env_checker=True,
        )
        self._gym.reset(seed=0)

    def picture(self, state: Float64Array, target: Float64Array | None, caption: str, size: int) -> Image.Image:
        """One frame.

        Args:
            state: ``[5]`` of agent and block.
            target: ``[2]`` where the agent is told to go, drawn as a cross; None to leave it out.
            caption: one or two short lines below the picture.
            size: width of the picture, pixels.

        Returns:
            RGB, ``size`` wide and a caption higher.
        """
        place(self._gym.unwrapped, state)
        image = Image.fromarray(np.asarray(self._gym.render()))
        if target is not None:
            x, y = (float(value) for value in target)
            draw = ImageDraw.Draw(image)
            draw.line([(x - 9, y), (x + 9, y)], fill=TARGET_COLOUR, width=4)
            draw.line([(x, y - 9), (x, y + 9)], fill=TARGET_COLOUR, width=4)
        canvas = Image.new("RGB", (size, size + CAPTION), "white")
        canvas.paste(image.resize((size, size), Image.Resampling.LANCZOS))
        ImageDraw.Draw(canvas).multiline_text((8, size + 4), caption, fill="black", font=ImageFont.load_default(13))
        return canvas


def save_animation(
    path: Path, episodes: Sequence[Episode], labels: Sequence[str], size: int = 288, every: int = 2
) -> None:
    """Write episodes side by side as a GIF; one that ends earlier holds its last frame.

    Args:
        path: of the GIF.
        episodes: at least one.
        labels: one an episode, written below it.
        size: width of each, pixels.
        every: simulation steps a frame; at 10 frames a second 2 is twice real time.
    """
    scene = Scene()
    last = max(len(episode.targets) for episode in episodes)
    frames = []
    for step in [*range(0, last, every), last]:
        parts = [_part(scene, episode, label, step, size) for episode, label in zip(episodes, labels, strict=True)]
        frame = Image.new("RGB", (size * len(parts), parts[0].height))
        for i, part in enumerate(parts):
            frame.paste(part, (i * size, 0))
        frames.append(frame)
    palette = _palette(frames[len(frames) // 2])
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [FRAME_MS] * (len(indexed) - 1) + [20 * FRAME_MS]
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=True)


def _palette(frame: Image.Image) -> Image.Image:
    """One palette for all frames, so that what does not move is the same in each and costs nothing."""
    sample = Image.new("RGB", (frame.width, frame.height + CAPTION), TARGET_COLOUR)  # rare in the frame, and needed
    sample.paste(frame)
    return sample.quantize(COLOURS)


def _part(scene: Scene, episode: Episode, label: str, step: int, size: int) -> Image.Image:
    now = min(step, len(episode.targets))
    best = f"   best coverage {episode.coverages[:now].max():.2f}" if now else ""  # it is told after each step
    target = None if now == len(episode.targets) else episode.targets[now]
    caption = f"{label}\n{now / 10:.1f} s{best}"
    return scene.picture(episode.states[now], target, caption, size)


@click.command()
@click.argument("variants", nargs=-1, required=True, metavar="DIR[:PLAN]...")
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path))
@first_seed_option
@runtime_option
@threads_option
def main(variants: tuple[str, ...], output: Path, first_seed: int, runtime: str, threads: int) -> None:
    """Run one episode with each variant, on the same seed, and draw them side by side."""
    episodes: list[Episode] = []
    with Progress(console=Console(stderr=True)) as progress:
        for text in progress.track(variants, description="running episodes"):
            variant = open_variant(text, runtime, threads)
            episodes += run_batch(variant.policy, [first_seed], variant.noise, variant.plan).episodes
    save_animation(output, episodes, variants)
    scores = ", ".join(f"{text} {episode.score:.3f}" for text, episode in zip(variants, episodes, strict=True))
    click.echo(f"{output}: {output.stat().st_size / 1e6:.2f} MB; scores: {scores}")


if __name__ == "__main__":
    run(main)
