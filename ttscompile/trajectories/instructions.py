"""The instructions of a recording as tokens, which is what a policy observes of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..core.spec import Instruction, ObservationSpec
from ..core.tokenizer import TASK, Tokenizer, padded
from ..errors import TrajectoryError
from .frames import Array, Frames, few


def instruction_rows(
    path: Path, held: Frames, told: Instruction, observations: Mapping[str, ObservationSpec], tokenizer: str
) -> dict[str, Array]:
    """Tokens and mask of every row, from its text.

    Args:
        held: what it holds: ``task``, texts ``[F]`` or their bytes ``[F, L]``.
        told: how the policy is told its task.
        tokenizer: path of ``tokenizer.json``, or of its folder.

    Returns:
        By key int64 ``[F, length]`` and bool ``[F, length]``.
    """
    if TASK not in held.names:
        found = f"{path}: has no array {TASK!r}; it has {few(held.names)}. Expected the text of each row, as LeRobot's"
        raise TrajectoryError(f"{found} data sets have it. Leave the tokenizer out, and record tokens.")
    texts = held.read(TASK)
    if texts.dtype == np.uint8 and texts.ndim == 2 and texts.shape[1]:
        texts = np.ascontiguousarray(texts).view(f"S{texts.shape[1]}")[:, 0]
    if texts.dtype.kind not in "US" or texts.ndim != 1:
        raise TrajectoryError(f"{path}: {TASK!r} is {texts.dtype}{list(texts.shape)}; expected texts [F].")
    different, rows = np.unique(texts, return_inverse=True)
    made = Tokenizer(tokenizer, TrajectoryError)
    lines = [each.decode(errors="replace") if isinstance(each, bytes) else each for each in different.tolist()]
    length = observations[told.tokens].shape[-1]
    tokens, mask = padded([made.of_task(line, told, length) for line in lines], length)
    return {told.tokens: tokens[rows], told.mask: mask[rows]}
