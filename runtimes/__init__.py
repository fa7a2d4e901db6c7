"""Runtimes: what executes a compiled policy. All take the same artifact and give the same answer.

- ``runtime``: what all of them do alike; ``backend``: what each of them has to provide; ``open``: which there are.
- ``reference``: torch, plain, differentiable; the definition of reuse.
- ``onnxruntime``: numpy and onnxruntime only; what runs on the robot.
- ``torch``: a call as one straight line, on any device that torch has.
- ``instructions``: what several of them make of a plan.
- ``policy``: the object that users hold, around any of them; ``load``: how they get it.

What a caller gives that does not fit is an ``ObservationError`` or an ``IllegalPlanError`` of any function of this
room. Parts of an artifact that do not fit each other are an ``ArtifactError``, and what this machine lacks a
``RuntimeUnavailableError``.
"""

from .open import open_runtime
from .report import CallReport, Timings
from .runtime import Runtime

__all__ = ["CallReport", "Runtime", "Timings", "open_runtime"]
