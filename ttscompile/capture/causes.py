"""Why a module cannot be captured, in words that need no knowledge of torch.export."""

import re
import traceback
from pathlib import PurePath

import torch
from torch._subclasses.fake_tensor import DataDependentOutputException

ON_VALUES = (
    "what it does depends on the values of a tensor: by an if, a while or an assert on one, by torch.equal, by a number"
    " taken out of one (.item(), .tolist(), float(), int()), or by a mask that picks entries (x[mask]). In place of an"
    " if or a mask write torch.where, compute with tensors, and leave checks out."
)
KEEPS = (
    " It keeps something of one call for the next, and a denoiser must not. Compute it in every call: what depends on"
    " the observation alone is taken out of the loop. Or make it a buffer in __init__."
)
_ADVICE = re.compile(r"\s*\n(?:Caused by: \(|For more information, run with|The error above occurred when calling)")
"""Where torch.export's messages turn to its own debugging."""


def cause_of(error: Exception, called: str) -> str:
    """Where it is, what is wrong and what to do, and the first of torch's words, or all where nothing is known."""
    place = innermost("".join(traceback.format_tb(error.__traceback__)))
    said = f"{type(error).__name__}: {sentence(_ADVICE.split(str(error))[0])}"
    if "data-dependent expression" in said or isinstance(error, DataDependentOutputException):
        return f"at {place}: {ON_VALUES}\nIn torch's words: {sentence(said.partition(' (unhinted')[0])}"
    general = "A denoiser must be one step (no sampling loop), without data-dependent control flow, for any batch size."
    return f"at {place}: {said}\nIt was called with {called}. {general}"


def sentence(said: object) -> str:
    """The same with a full stop."""
    return f"{said}".strip().rstrip(".") + "."


def innermost(trace: str) -> str:
    """``file:line in function`` of the innermost frame outside torch; the file's name only, no path of this machine."""
    frames = re.findall(r'File "([^"]+)", line (\d+), in (\S+)', trace)
    ours = PurePath(__file__).parent, PurePath(torch.__file__).parent
    own = [frame for frame in frames if not any(PurePath(frame[0]).is_relative_to(each) for each in ours)]
    if not frames:
        return "source unknown"
    path, line, function = (own or frames)[-1]
    return f"{PurePath(path).name}:{line} in {function}"
