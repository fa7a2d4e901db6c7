"""Every error that ttscompile raises on purpose.

One tree, so that a caller can catch ``TtscompileError`` and print it: the message says what is wrong, where,
what was expected, what was found, and what to do about it.
"""

from __future__ import annotations


class TtscompileError(Exception):
    """Base of all errors of this package; the CLI prints its message and exits with status 2."""


class CheckpointError(TtscompileError):
    """A checkpoint that cannot be read, is refused for safety, or does not hold a supported policy."""


class SpecError(TtscompileError):
    """A policy specification (sampler, chunk, normaliser, conditions) that contradicts itself or the module."""


class CaptureError(TtscompileError):
    """The denoiser could not be captured as a graph, or its graph uses something the compiler cannot express."""


class PassError(TtscompileError):
    """A pass found its precondition or postcondition violated; names the pass, the node and its neighbours."""


class NoResidualBlocksError(PassError):
    """The denoiser has no chain of residual additions; names the node where the search ended."""


class LoweringError(TtscompileError):
    """A graph could not be lowered to ONNX."""


class ArtifactError(TtscompileError):
    """An artifact that is missing, truncated, changed since it was written, or of another schema version."""


class ObservationError(TtscompileError):
    """An observation, or noise, that does not fit the specification of the policy."""


class IllegalPlanError(TtscompileError):
    """A plan that has the wrong shape or reads a residual which was never computed."""


class TrajectoryError(TtscompileError):
    """Recorded trajectories that cannot be read or do not fit the policy."""


class CalibrationError(TtscompileError):
    """Calibration cannot start, cannot resume, or did not reach its target."""


class CalibrationFailedError(CalibrationError):
    """Calibration ran, and its plan is not what was asked for; a failed check (exit status 1), not bad input."""


class OutputError(TtscompileError):
    """A result that cannot be written where it was asked for."""


class RuntimeUnavailableError(TtscompileError):
    """A runtime was asked for whose packages or providers are not installed."""
