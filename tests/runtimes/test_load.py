"""Loading an artifact where there is no torch, and loading none where there is."""

import json
import subprocess
import sys
import textwrap
import venv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.source import source_copy

ROOT = Path(__file__).resolve().parents[2]
COMPILERS_ONLY = ["diffusers", "matplotlib", "onnx", "onnx_ir", "onnxscript", "pydantic", "safetensors", "torch"]

ACT = textwrap.dedent(
    """
    import json, sys, time
    started = time.process_time()  # of the processor: something else may run beside it
    import ttscompile
    policy = ttscompile.load(sys.argv[1])
    loaded = time.process_time() - started
    import numpy as np
    with np.load(sys.argv[2]) as given:
        noise = ttscompile.Noise(given["initial"], given["steps"])
        out = policy.predict_action({"obs": given["obs"]}, noise=noise, plan="dense")
    print(json.dumps({"seconds": loaded, "modules": sorted(sys.modules), "action": out["action"].tolist()}))
    """
)


@pytest.fixture(scope="module")
def call(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One observation of the Push-T policy, and noise."""
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("call") / "call.npz"
    np.savez(
        path,
        obs=rng.uniform(100, 400, (1, 2, 20)).astype(np.float32),
        initial=rng.standard_normal((1, 16, 2), dtype=np.float32),
        steps=rng.standard_normal((100, 1, 16, 2), dtype=np.float32),
    )
    return path


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of a new environment that has numpy, onnxruntime and this project, and nothing that they do not need."""
    folder = tmp_path_factory.mktemp("robot")
    venv.create(folder)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--disable-pip-version-check"]
    pip.append("--no-compile")  # Python compiles what it imports
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), "numpy", "onnxruntime"], check=True)
    subprocess.run([*pip, "--no-deps", str(source_copy(folder / "source"))], check=True)
    return python


def act(python: Path | str, artifact: Path, call: Path) -> dict[str, Any]:
    """Load and act in another process, started where no part of the source tree can be imported by accident."""
    command = [str(python), "-W", "error", "-c", ACT, str(artifact), str(call)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=call.parent, check=False)
    assert result.returncode == 0, result.stderr
    report: dict[str, Any] = json.loads(result.stdout)
    return report


@pytest.fixture(scope="module")
def here(compiled_pusht: Path, call: Path) -> dict[str, Any]:
    """What acts in the full environment."""
    return act(sys.executable, compiled_pusht, call)


@pytest.mark.slow
def test_a_robot_without_torch_acts_as_the_full_environment_does(
    robot: Path, compiled_pusht: Path, call: Path, here: dict[str, Any]
) -> None:
    runs = [act(robot, compiled_pusht, call) for _ in range(2)]
    assert not set(COMPILERS_ONLY) & set(runs[0]["modules"])
    assert not {"click", "rich"} & set(runs[0]["modules"]), "they are the command line's, and not installed there"
    np.testing.assert_array_equal(runs[0]["action"], here["action"])
    seconds = min(run["seconds"] for run in runs)
    print(f"import and load without torch: {seconds:.3f} s")
    assert seconds < 2.0


@pytest.mark.slow
def test_loading_imports_nothing_of_the_compilers_where_it_is_installed(here: dict[str, Any]) -> None:
    assert not set(COMPILERS_ONLY) & set(here["modules"])


def test_what_needs_the_compiler_says_so_on_a_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)  # import torch now fails as if it were not installed
    for name in [n for n in sys.modules if n.startswith(("ttscompile.driver", "ttscompile.frontends"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(vars(ttscompile), "convert", raising=False)
    monkeypatch.delattr(ttscompile, "driver", raising=False)
    with pytest.raises(ttscompile.TtscompileError, match=r"needs torch, .* pip install 'ttscompile\[compile\]'"):
        ttscompile.convert  # noqa: B018
