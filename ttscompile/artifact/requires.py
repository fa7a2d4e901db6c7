"""Whether the onnxruntime of this machine can run an artifact."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from ..errors import ArtifactError
from ..measure.versions import release
from .manifest import Requires


def check_runtime(requires: Requires, directory: Path) -> None:
    """Raise ArtifactError if onnxruntime is there, and too old for the graphs of an artifact."""
    if importlib.util.find_spec("onnxruntime") is None:
        return  # the reference runtime does without; the onnxruntime runtime says that it is missing
    # From 1.31 on it reports its use to its makers, on threads of its own, for which the end of a forked child waits.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    found = str(onnxruntime.__version__)
    if release(found) < release(requires.onnxruntime):
        raise ArtifactError(
            f"{directory}: its graphs (opset {requires.opset}) need onnxruntime >= {requires.onnxruntime}; {found} is"
            f" installed. Run: pip install 'onnxruntime>={requires.onnxruntime}'."
        )
