"""Draws disturbed.png: what both cameras see in the world with instructions, as it was recorded and otherwise.

MUJOCO_GL=osmesa python docs/pictures/disturbed.py [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(1, str(Path(__file__).parents[2] / "examples" / "evaluation"))

from environments import Environment, disturbances, environment_class

SHOWN = ("table", "dark", "noisy", "shaken", "late", "moved")
"""The others look as recordings do: only their words differ."""
SEED, STEPS = 7, 14


def seen(environment: Environment) -> npt.NDArray[np.float32]:
    """Both pictures of one time in an episode, beside each other: ``[H, 2 W, 3]``."""
    environment.reset(SEED)
    for _ in range(STEPS):
        environment.observe()
        environment.step(np.array([0.3, 0.2, -0.1, 1.0]))
    frame = environment.observe()
    environment.close()
    cameras = (frame[f"observation.images.{name}"] for name in ("front", "wrist"))
    return np.concatenate([np.moveaxis(picture, 0, -1) for picture in cameras], axis=1)


def draw(path: Path) -> None:
    """Write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = {"as recorded": environment_class("fetch-blocks")}
    made |= {name: kind for name, kind in disturbances("fetch-blocks").items() if name in SHOWN}
    figure = Figure(figsize=(8.0, 2.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 4)
    for each in axes.flat:
        each.axis("off")
    for each, (name, kind) in zip(axes.flat, made.items(), strict=False):
        each.imshow(seen(kind()))
        each.set_title(name, fontsize=9)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    draw(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("disturbed.png")))
