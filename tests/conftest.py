"""Fixtures that several suites share: the team's golden files, the Push-T checkpoint and its artifact."""

from __future__ import annotations

import gc
import importlib.util
import logging
import re
import signal
import sys
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import ttscompile
from ttscompile.ir.program import Program
from ttscompile.measure.machine import has_integer_dot_product

from .once import Once
from .untraced import pytest_runtest_protocol as pytest_runtest_protocol

if TYPE_CHECKING:
    from _pytest.terminal import TerminalReporter
    from torch import nn

ROOT = Path(__file__).resolve().parents[1]
DEEPER = re.compile(r"model\.decoder\.layers\.[1-9]")
NO_SHARED = "NO GOLDEN FILES: no folder 'shared' with DESIGN.md and golden/ beside the repository or an ancestor of it"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where there is no torch, artifacts come from a machine that has it: ``tests/machines/made.py``."""
    parser.addoption("--made", type=Path, help="keep what is made once a run in this folder, and use what is there")


def pytest_configure(config: pytest.Config) -> None:
    """One thread for each of torch's operations: those of the tests are small, and wait for each other otherwise.

    Where the processor has no integer dot products, every policy with blocks of eight or four bits warns that it is
    slow there. That is no error of the test that loads it; that it warns, a test of its own checks.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has what it runs in the background ignore it
    if not has_integer_dot_product():
        config.addinivalue_line("filterwarnings", "ignore:precision 'int[48]' is fast on a processor:UserWarning")
    if importlib.util.find_spec("hypothesis") is not None:
        from hypothesis import HealthCheck, settings

        # What else the machine does may slow an example down.
        settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
        settings.load_profile("any machine")
    if importlib.util.find_spec("torch") is not None:
        import torch

        # Torch would look up Python's stack for each line of this log, which nobody reads.
        logging.getLogger("torch.__trace").handlers.clear()
        torch.set_num_threads(1)
        torch.set_warn_always(True)  # a warning that is given once is an error of whichever test comes first


def pytest_sessionstart(session: pytest.Session) -> None:
    """Where pytest listens to logs, it hears warnings: torch's tracer tells a page a test at lower levels.

    The entry ``log_level`` would say so, but it is unknown where ``make test`` leaves the plugin out.
    """
    if (logs := session.config.pluginmanager.get_plugin("logging-plugin")) is not None:
        for handler in (logs.caplog_handler, logs.report_handler):
            handler.setLevel(logging.WARNING)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported stays: Python need not look through it for garbage again, which takes a tenth of a run."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()
        gc.set_threshold(50_000, 20, 100)


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    """Say how much was not tested for want of the golden files: a green run without them proves less."""
    skipped = [r for r in terminalreporter.stats.get("skipped", []) if NO_SHARED in str(r.longrepr)]
    if skipped:
        terminalreporter.section("golden files are missing", sep="!", red=True, bold=True)
        terminalreporter.line(f"{len(skipped)} tests were skipped: {NO_SHARED}.", red=True)


def find_shared(start: Path) -> Path | None:
    """The folder ``shared`` beside ``start`` or beside one of its ancestors; None if there is none."""
    candidates = (folder.parent / "shared" for folder in (start, *start.parents))
    return next((c for c in candidates if (c / "DESIGN.md").is_file() and (c / "golden").is_dir()), None)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the golden files; without it the test is skipped, and the end of the run says so."""
    folder = find_shared(ROOT)
    if folder is None:
        pytest.skip(NO_SHARED)
    return folder


@pytest.fixture(scope="session")
def pusht_checkpoint() -> Path:
    """The Push-T policy of the example, as the original Diffusion Policy code saved it (half-precision weights)."""
    return ROOT / "examples" / "pusht" / "pusht_dpt_ema_fp16.ckpt"


@pytest.fixture(scope="session")
def once(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Folders that all modules and workers of this run share: read them only."""
    if (made := request.config.getoption("made")) is not None:
        return Once(made)
    own = tmp_path_factory.getbasetemp()
    return Once((own.parent if hasattr(request.config, "workerinput") else own) / "once")


@pytest.fixture(scope="session", autouse=True)
def tracers(once: Once) -> Iterator[None]:
    """Torch's tracer, its exporter and diffusers' schedulers are what most tests of policies would wait for."""
    if importlib.util.find_spec("torch") is None:
        yield
        return
    from .capturer import captured_once
    from .exporter import exported_once
    from .loops_once import measured_once

    with captured_once(once.directory / "captures"), exported_once(once.directory / "exports"), measured_once():
        yield


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Policies that are run with more of torch's threads change them for the process, and so for the next test."""
    yield
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


@pytest.fixture(scope="session")
def toy_compiled(once: Once) -> Path:
    """A toy artifact: five steps, five blocks, an untrained pruner, not calibrated. Copy it before changing it."""

    def make(directory: Path) -> object:
        from .runtimes.toys import toy_program, written_artifact  # they need torch, and --made brings the toy along

        return written_artifact(toy_program(), directory)

    return once.folder("toy", make)


@pytest.fixture(scope="session")
def compiled_pusht(pusht_checkpoint: Path, once: Once) -> Path:
    """The artifact of the Push-T policy, not calibrated, and ``call.onnx``, its single file, beside it.

    Compiled once a run: copy it before changing it.
    """

    def convert(directory: Path) -> Program:
        return ttscompile.convert(pusht_checkpoint, directory, single_file=directory.parent / "call.onnx")

    return once.compiled("pusht", convert)[0]


def first_layer(checkpoint: Path, directory: Path, width: int) -> None:
    """Save the Push-T policy with the first of its eight layers, and the first channels of each of its four heads."""
    import torch

    from ttscompile.frontends.checkpoint import plain_config, read_checkpoint

    payload = read_checkpoint(checkpoint)
    config = plain_config(payload["cfg"])
    config["policy"]["model"] |= {"n_layer": 1, "n_emb": width}
    kept = torch.arange(256).view(4, 64)[:, : width // 4].flatten()
    axes = {256: kept, 768: torch.cat([kept, 256 + kept, 512 + kept]), 1024: torch.arange(4 * width)}
    weights = {}
    for name, value in payload["state_dicts"]["ema_model"].items():
        if not DEEPER.match(name):
            for axis, size in enumerate(value.shape):
                value = value.index_select(axis, axes[size]) if size in axes else value
            weights[name] = value
    directory.mkdir()
    torch.save({"cfg": config, "state_dicts": {"ema_model": weights}, "pickles": {}}, directory / "policy.ckpt")


@pytest.fixture(scope="session")
def one_layer_checkpoint(pusht_checkpoint: Path, once: Once) -> Path:
    """One layer of the Push-T policy, a quarter as wide: three blocks, soon converted and soon computed."""
    return once.folder("one_layer", lambda directory: first_layer(pusht_checkpoint, directory, 64)) / "policy.ckpt"


@pytest.fixture(scope="session")
def whole_layer_checkpoint(pusht_checkpoint: Path, once: Once) -> Path:
    """One layer as it was trained, of which a search of a moment finds a plan."""
    return once.folder("whole_layer", lambda directory: first_layer(pusht_checkpoint, directory, 256)) / "policy.ckpt"


@pytest.fixture(scope="session")
def compiled_layer(one_layer_checkpoint: Path, once: Once) -> Path:
    """The artifact of ``one_layer_checkpoint``: 100 steps, a block of each kind. Copy it before changing it."""
    return once.compiled("one layer", lambda directory: ttscompile.convert(one_layer_checkpoint, directory))[0]


@pytest.fixture(scope="session")
def compiled_module(once: Once) -> Callable[[str], tuple[nn.Module, Path]]:
    """By name in ``tests.passes.test_pipeline.MODULES``: the module, and the folder of its artifact and single file.

    They are called ``artifact`` and ``new/call.onnx``; nobody made ``new`` before.
    """

    def compiled(name: str) -> tuple[nn.Module, Path]:
        import torch

        from .passes.modules import MODULES, spec

        torch.manual_seed(0)
        module = MODULES[name]().eval()

        def compile_denoiser(directory: Path) -> Program:
            file = directory.parent / "new" / "call.onnx"
            return ttscompile.compile_denoiser(module, spec(), directory, single_file=file)

        return module, once.compiled(f"module {name}", compile_denoiser)[0].parent

    return compiled
