"""An ahead-of-time compiler for diffusion policies of robots.

``import ttscompile`` loads neither torch nor onnx: the names below are imported when they are first used (PEP 562), so
that a robot with numpy and onnxruntime alone can ``load`` an artifact, and the compiler's dependencies are only needed
by ``build``, ``convert``, ``calibrate`` and ``compile_denoiser``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .measure.versions import VERSION as __version__

if TYPE_CHECKING:
    from .builder import build as build
    from .calibration.pipeline import calibrate as calibrate
    from .core.lattice import Source as Source, legalize as legalize
    from .core.plan import Plan as Plan, TokenReuse as TokenReuse
    from .core.spec import (
        Affine as Affine,
        ChunkSpec as ChunkSpec,
        Noise as Noise,
        ObservationSpec as ObservationSpec,
        PolicySpec as PolicySpec,
        SamplerTable as SamplerTable,
    )
    from .driver import compile_denoiser as compile_denoiser, convert as convert
    from .errors import TtscompileError as TtscompileError
    from .report.push import push as push
    from .runtimes.executor import (
        AsyncExecutor as AsyncExecutor,
        ExecutorSettings as ExecutorSettings,
        GuardLimits as GuardLimits,
        Shadow as Shadow,
    )
    from .runtimes.info import PolicyInfo as PolicyInfo
    from .runtimes.load import load as load
    from .runtimes.policy import CompiledPolicy as CompiledPolicy
    from .runtimes.report import CallReport as CallReport
    from .runtimes.torch.module import to_module as to_module
    from .samplers.edm import EDMDenoiser as EDMDenoiser, edm_table as edm_table
    from .samplers.flow import flow_matching_table as flow_matching_table
    from .samplers.table import DirectDenoiser as DirectDenoiser, direct_table as direct_table
    from .verification import Verification as Verification, verify as verify

_HOMES = {
    name: home
    for home, names in {
        "builder": ("build",),
        "calibration.pipeline": ("calibrate",),
        "core.lattice": ("Source", "legalize"),
        "core.plan": ("Plan", "TokenReuse"),
        "core.spec": ("Affine", "ChunkSpec", "Noise", "ObservationSpec", "PolicySpec", "SamplerTable"),
        "driver": ("compile_denoiser", "convert"),
        "errors": ("TtscompileError",),
        "report.push": ("push",),
        "runtimes.report": ("CallReport",),
        "runtimes.executor": ("AsyncExecutor", "ExecutorSettings", "GuardLimits", "Shadow"),
        "runtimes.info": ("PolicyInfo",),
        "runtimes.load": ("load",),
        "runtimes.policy": ("CompiledPolicy",),
        "runtimes.torch.module": ("to_module",),
        "samplers.table": ("DirectDenoiser", "direct_table"),
        "samplers.edm": ("EDMDenoiser", "edm_table"),
        "samplers.flow": ("flow_matching_table",),
        "verification": ("Verification", "verify"),
    }.items()
    for name in names
}
__all__ = ["__version__", *sorted(_HOMES)]


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
