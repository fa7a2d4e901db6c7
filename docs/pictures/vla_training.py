"""Draws vla_training.png: how the policies of the world with instructions learned.

python docs/pictures/vla_training.py [FILE]

The curves are the ``log.jsonl`` that ``examples/policies/vla/train.py`` wrote beside each kept policy.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

TRAINED = Path(__file__).resolve().parents[2] / "examples" / "policies" / "vla" / "trained"
LOSSES = {
    "loss": "what the policy is trained for",
    "places": "where the blocks are, told by all that is known",
    "pictures": "the same, told by each picture",
}


def draw(path: Path) -> None:
    """Write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    logs = sorted(TRAINED.glob("*/log.jsonl"))
    figure = Figure(figsize=(4.2 * len(logs), 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, log in zip(figure.subplots(1, len(logs), squeeze=False).flat, logs, strict=True):
        rows = [json.loads(line) for line in log.read_text().splitlines()]
        for name, label in LOSSES.items():
            known = [(row["update"], row[name]) for row in rows if name in row]
            axes.plot(*zip(*known, strict=True), label=label)
        axes.set(title=log.parent.name, xlabel="updates", yscale="log")
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("error")
    figure.axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    draw(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("vla_training.png")))
