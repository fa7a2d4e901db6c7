"""LeRobot's SmolVLA beside FastCrest Tether (pypi.org/project/fastcrest-tether): the same weights and the same call.

    python examples/benchmark/large.py --smolvla --output DIR
    pip install 'fastcrest-tether[monolithic]'    # in an environment of its own: Python 3.12, lerobot 0.5.1
    tether export DIR/smolvla --output DIR/tether
    python examples/benchmark/tether_beside.py DIR [--threads 1]

Tether writes the whole call as one ONNX model, with all steps of the loop in it, and runs it in onnxruntime. The model
has three cameras and 16 words, whatever the policy has: the third camera is masked, and in our calls as few words
count. Tether reads the processor of the language model, which has to be on the machine. See ``beside.py`` for what is
timed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
import onnxruntime
from beside import Array, race, race_options
from large_smolvla import CAMERAS, STATE

from ttscompile import Noise

MODEL = Path("tether") / "model.onnx"


class Tether:
    """The exported model; see ``beside.Rival``.

    Args:
        model: the ONNX file.
        threads: of its arithmetic.
    """

    parts = "all of it"

    def __init__(self, model: Path, threads: int) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        self._shapes = {one.name: one.shape for one in self._session.get_inputs()}

    @property
    def words(self) -> int:
        """Tokens of an instruction."""
        return int(self._shapes["lang_tokens"][1])

    def predict(self, obs: Mapping[str, Array], noise: Noise) -> tuple[Array, list[float]]:
        """The actions ``[T, D]``, and seconds."""
        (tokens,) = (value for key, value in obs.items() if key.endswith("tokens"))
        state = np.zeros(self._shapes["state"], np.float32)
        state[:, : obs[STATE].size] = obs[STATE].reshape(1, -1)
        given: dict[str, Any] = {
            "lang_tokens": tokens.reshape(1, -1)[:, : self.words],
            "lang_masks": np.ones((1, self.words), bool),
            "state": state,
            "noise": noise.initial,
        }
        cameras = sum(name.startswith("img_cam") for name in self._shapes)
        pictures = [obs[key][:, 0] * 2 - 1 for key in CAMERAS]
        blank = np.full_like(pictures[0], -1)
        for number in range(cameras):
            there = number < len(pictures)
            given[f"img_cam{number + 1}"] = pictures[number] if there else blank
            given[f"mask_cam{number + 1}"] = np.array([there])
        start = time.perf_counter()
        (actions,) = self._session.run(None, {name: given[name] for name in self._shapes})
        return np.asarray(actions)[0], [time.perf_counter() - start]


@click.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@race_options
def main(folder: Path, threads: int, rounds: int, fp32: bool) -> None:
    """Time calls of the policy in FOLDER, and of what Tether exported of it."""
    tether = Tether(folder / MODEL, threads)
    race(folder, {"Tether": tether}, threads, rounds, fp32, tether.words)


if __name__ == "__main__":
    main()
