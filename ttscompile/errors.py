"""Every error that ttscompile raises on purpose.

One tree, so that a caller can catch ``TtscompileError`` and print it: the message says what is wrong, where,
what was expected, what was found, and what to do about it.
"""

from collections.abc import Iterator
from contextlib import contextmanager


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
    """No chain of residual additions holds most of the denoiser; says where the search ended."""


class LoweringError(TtscompileError):
    """A graph could not be lowered to ONNX."""


class ArtifactError(TtscompileError):
    """An artifact that is missing, truncated, changed since it was written, or of another schema version."""


class ArtifactChangedError(ArtifactError):
    """An artifact that was replaced or changed while it was being read; reading it again finds what is there now."""


class ObservationError(TtscompileError):
    """An observation, noise, or a prefix of actions that does not fit the specification of the policy."""


class NonFiniteActionsError(TtscompileError):
    """A call of a policy whose arithmetic overflowed: its actions are not numbers that a robot can be given."""


class IllegalPlanError(TtscompileError):
    """A plan that has the wrong shape or reads a residual which was never computed."""


class TrajectoryError(TtscompileError):
    """Recorded trajectories that cannot be read or do not fit the policy."""


class CalibrationError(TtscompileError):
    """Calibration cannot start, cannot resume, or did not reach its target."""


class CalibrationFailedError(CalibrationError):
    """Calibration ran, and its plan is not what was asked for; a failed check (exit status 1), not bad input."""


class ClusterError(TtscompileError):
    """The machines that the work was given to are gone, or were never there."""


class OutputError(TtscompileError):
    """A result that cannot be written where it was asked for."""


class HubError(TtscompileError):
    """A repository of the hub that cannot be had or written, or does not hold what was asked for."""


class ReportError(TtscompileError):
    """What a report was asked to show cannot be read."""


class RuntimeUnavailableError(TtscompileError):
    """A runtime was asked for whose packages or providers are not installed."""


class ExecutorError(TtscompileError):
    """The executor was used in a way, or asked for a time, that it cannot serve."""


class InfeasibleError(ExecutorError):
    """The policy is too slow for its chunks at this rate; the message has the arithmetic."""


class OverloadedError(ExecutorError):
    """A server has as many requests under way as it may; ask again later."""


class DeadlineMissedError(ExecutorError):
    """There is no action for the time that was asked for, and none may be held any longer."""


class StaleObservationError(DeadlineMissedError):
    """The same, because no observation came that is recent enough to compute actions from."""


class WorkerDeadError(ExecutorError):
    """The thread that owns the policy has ended; ``__cause__`` is what ended it."""


class ExecutorClosedError(ExecutorError):
    """The executor was closed."""


class ProtocolError(ExecutorError):
    """A message to the executor's server that is no request of its protocol."""


def first_line(error: BaseException) -> str:
    """What an error of another library says, on one line; its class where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


@contextmanager
def needing(what: str, extra: str, otherwise: str = "") -> Iterator[None]:
    """Within the block, which imports, a package that is not installed is told with the extra that installs it.

    ``what`` is in need of it, for the message; ``otherwise`` says after the command what else can be done.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        told = f"{what} needs {error.name}, which is not installed"
        raise RuntimeUnavailableError(f"{told}. Run: pip install 'ttscompile[{extra}]'{otherwise}.") from error
