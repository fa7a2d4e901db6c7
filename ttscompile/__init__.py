"""An ahead-of-time compiler for diffusion-transformer robot policies.

``import ttscompile`` loads neither torch nor onnx: the names below are imported when they are first used (PEP 562), so
that a robot with numpy and onnxruntime alone can ``load`` an artifact, and the compiler's dependencies are only needed
by ``convert``, ``calibrate`` and ``compile_denoiser``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .measure.versions import VERSION as __version__

if TYPE_CHECKING:
    from .calibration import calibrate
    from .core.lattice import Source, legalize
    from .core.spec import Affine, ChunkSpec, Noise, ObservationSpec, PolicySpec, SamplerTable
    from .driver import compile_denoiser, convert
    from .errors import TtscompileError
    from .runtimes.executor import AsyncExecutor, ExecutorSettings, GuardLimits
    from .runtimes.policy import CompiledPolicy, PolicyInfo, load
    from .runtimes.report import CallReport
    from .samplers.edm import EDMDenoiser, edm_table
    from .samplers.flow import flow_matching_table
    from .verification import Verification, verify

__all__ = [
    "Affine",
    "AsyncExecutor",
    "CallReport",
    "ChunkSpec",
    "CompiledPolicy",
    "EDMDenoiser",
    "ExecutorSettings",
    "GuardLimits",
    "Noise",
    "ObservationSpec",
    "PolicyInfo",
    "PolicySpec",
    "SamplerTable",
    "Source",
    "TtscompileError",
    "Verification",
    "__version__",
    "calibrate",
    "compile_denoiser",
    "convert",
    "edm_table",
    "flow_matching_table",
    "legalize",
    "load",
    "verify",
]

_HOMES = {
    "Affine": "core.spec",
    "AsyncExecutor": "runtimes.executor",
    "CallReport": "runtimes.report",
    "ChunkSpec": "core.spec",
    "CompiledPolicy": "runtimes.policy",
    "EDMDenoiser": "samplers.edm",
    "ExecutorSettings": "runtimes.executor",
    "GuardLimits": "runtimes.executor",
    "Noise": "core.spec",
    "ObservationSpec": "core.spec",
    "PolicyInfo": "runtimes.policy",
    "PolicySpec": "core.spec",
    "SamplerTable": "core.spec",
    "Source": "core.lattice",
    "TtscompileError": "errors",
    "Verification": "verification",
    "calibrate": "calibration",
    "compile_denoiser": "driver",
    "convert": "driver",
    "edm_table": "samplers.edm",
    "flow_matching_table": "samplers.flow",
    "legalize": "core.lattice",
    "load": "runtimes.policy",
    "verify": "verification",
}


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    try:
        value = getattr(importlib.import_module(f"{__name__}.{home}"), name)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == __name__:
            raise
        from .errors import RuntimeUnavailableError

        raise RuntimeUnavailableError(
            f"{__name__}.{name} needs {error.name}, which is not installed. Run: pip install '{__name__}[compile]'."
        ) from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
