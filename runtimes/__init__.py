"""Runtimes: what executes a compiled policy. All take the same artifact and give the same answer.

- ``reference``: torch, plain, differentiable; the definition of reuse.
- ``onnxruntime_cpu``: numpy and onnxruntime only; what runs on the robot.
- ``policy``: the object that users hold, around either.
"""

from __future__ import annotations

from .base import CallReport, Runtime, Timings, open_runtime

__all__ = ["CallReport", "Runtime", "Timings", "open_runtime"]
