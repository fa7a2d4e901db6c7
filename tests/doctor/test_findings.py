"""The doctor: what it sees, that every trouble has a remedy, and that it works where nothing else does."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from tests.artifact.folders import flip
from tests.commands import done, refused, run
from tests.pages import ROOT
from tests.plans import store_schedules
from ttscompile.cli import main
from ttscompile.core.finding import Finding, Level
from ttscompile.core.lattice import uniform_plan
from ttscompile.doctor import diagnosis as doctor, machine as doctor_machine
from ttscompile.doctor.target import artifact_findings
from ttscompile.measure.versions import release


@pytest.fixture(scope="module")
def calibrated(toy_compiled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with a schedule."""
    directory = tmp_path_factory.mktemp("doctor") / "calibrated"
    shutil.copytree(toy_compiled, directory)
    store_schedules(directory, None, {"schedule": uniform_plan(5, 5, 2)}, "schedule", {"learned": ["interval"]})
    return directory


def found(what: str, findings: list[Finding]) -> Finding:
    matching = [finding for finding in findings if finding.what == what]
    assert len(matching) == 1, f"{what}: {[finding.what for finding in findings]}"
    return matching[0]


def system(root: Path, **files: str) -> Path:
    """A root with some of the system's files; ``__`` in a name stands for a slash."""
    for name, content in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return root


def test_an_artifact_that_runs_here_has_no_problem(calibrated: Path) -> None:
    result = run("doctor", calibrated, "--json")
    told = json.loads(result.stdout)
    assert (result.exit_code, told["ok"], told["problems"]) == (0, True, 0)
    by_name = {finding["what"]: finding for finding in told["findings"]}
    assert by_name["plan"]["found"].startswith("default 'schedule'; it has ")
    assert "calls a second" in by_name["call"]["found"]
    assert "CPUExecutionProvider" in by_name["providers"]["found"]
    assert all(f["remedy"] for f in told["findings"] if f["level"] in ("warning", "problem"))


def test_the_same_as_text(calibrated: Path) -> None:
    told = done("doctor", calibrated).stdout
    for expected in ("onnxruntime", "threads=1", "identity", "MiB of rollout cache", "No problem"):
        assert expected in told


def test_a_damaged_artifact_is_a_problem_with_its_remedy(calibrated: Path, tmp_path: Path) -> None:
    damaged = shutil.copytree(calibrated, tmp_path / "damaged")
    flip(damaged / "weights.safetensors", -1)
    result = run("doctor", damaged)
    assert result.exit_code == 1
    assert "PROBLEM load" in result.stdout
    assert "the file was changed since it was written" in result.stdout
    assert "1 problem, " in result.stdout


def test_an_artifact_that_is_not_calibrated_is_a_warning(toy_compiled: Path) -> None:
    finding = found("plan", doctor.examine(toy_compiled))
    assert finding.level is Level.WARNING
    assert "ttscompile calibrate" in finding.remedy


def test_a_folder_that_is_not_there_is_bad_input() -> None:
    assert refused("doctor", "/nowhere")
    assert doctor.main(["/nowhere"]) == 2
    assert doctor.main(["--wrong"]) == 2


def test_it_says_what_is_missing_where_hardly_anything_is_installed(calibrated: Path) -> None:
    """Started without the command line's packages, numpy, onnxruntime and torch."""
    code = (
        "import sys, runpy\n"
        "for name in ('click', 'rich', 'numpy', 'onnxruntime', 'torch'): sys.modules[name] = None\n"
        f"sys.argv = ['doctor', {str(calibrated)!r}]\n"
        "runpy.run_module('ttscompile.doctor', run_name='__main__')\n"
    )
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 1, result.stderr
    assert result.stderr == ""
    assert "onnxruntime is not installed" in result.stdout
    assert "-> Run: pip install onnxruntime." in result.stdout
    assert "numpy is not installed" in result.stdout


def test_packages_that_are_too_old_or_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"numpy": "1.26.4", "torch": None, "rich": None}

    def version(name: str) -> str:
        if name in versions:
            if versions[name] is None:
                raise metadata.PackageNotFoundError(name)
            return str(versions[name])
        return metadata.version(name)

    monkeypatch.setattr(doctor_machine, "version", version)
    findings = doctor_machine.package_findings()
    assert found("numpy", findings).level is Level.PROBLEM
    assert found("numpy", findings).remedy.startswith("Run: pip install 'numpy>=2.0'")
    assert found("rich", findings).level is Level.WARNING, "the command line's alone"
    extra = found("extra 'compile'", findings)
    assert extra.level is Level.NOTE, "a robot needs no torch"
    assert "torch (needs 2.11)" in extra.found
    assert "pip install 'ttscompile[compile]'" in extra.remedy


def test_requirements_are_read_with_their_extras() -> None:
    wanted = doctor_machine.requirements()
    assert ("numpy", "2.0", "") in wanted
    assert ("torch", "2.11", "compile") in wanted
    assert ("metaworld", "3.1.1", "examples") in wanted, "of one version alone"
    assert all(each.least for each in wanted)
    assert found("extra 'videos'", doctor_machine.package_findings()).level in (Level.OK, Level.NOTE)
    assert release("2.13.0+cpu") == (2, 13)


def test_every_extra_of_users_is_told_with_commands_and_options_that_there_are() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(doctor_machine.ENABLES) == set(extras) - {"dev", "docs", "release"}
    told = re.findall(r"(\w+) (--?[a-z-]+)\b", ", ".join(doctor_machine.ENABLES.values()))
    assert ("calibrate", "--ray") in told
    assert ("serve", "--copies") in told
    for command, option in told:
        assert option in {name for each in main.commands[command].params for name in each.opts}, command


@pytest.mark.parametrize(
    ("files", "what", "level", "told"),
    [
        ({"proc__cpuinfo": "model name: old\nflags: sse2 avx\n"}, "instructions", Level.WARNING, "not AVX2"),
        ({"proc__cpuinfo": "flags: avx2 avx512_vnni\n"}, "instructions", Level.OK, "AVX2, AVX-512 VNNI"),
        ({"sys__fs__cgroup__cpu.max": "50000 100000\n"}, "limit of the control group", Level.WARNING, "0.5 cores"),
        ({"sys__fs__cgroup__cpu__cpu.cfs_quota_us": "200000\n", "sys__fs__cgroup__cpu__cpu.cfs_period_us": "100000\n"},
         "limit of the control group", Level.NOTE, "2 cores"),
        ({"sys__devices__system__cpu__cpu0__cpufreq__scaling_governor": "powersave\n"},
         "frequency governor", Level.WARNING, "powersave"),
        ({"sys__devices__system__clocksource__clocksource0__current_clocksource": "hpet\n"},
         "source", Level.WARNING, "hpet"),
        ({"proc__meminfo": "MemTotal: 9 kB\nMemAvailable: 2097152 kB\n"}, "available", Level.OK, "2.0 GiB"),
        ({"proc__meminfo": "MemAvailable: 2097152 kB\n", "sys__fs__cgroup__memory.max": f"{2**30}\n"},
         "available", Level.OK, "1.0 GiB"),
    ],
)  # fmt: skip
def test_what_the_system_says_of_itself(
    files: dict[str, str], what: str, level: Level, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    finding = found(what, doctor_machine.machine_findings(system(tmp_path, **files)))
    assert finding.level is level
    assert told in finding.found


def test_arm_processors_have_names_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    root = system(tmp_path, proc__cpuinfo="Features\t: fp asimd asimddp i8mm\n")
    assert found("instructions", doctor_machine.machine_findings(root)).found.startswith("NEON, dotprod, i8mm; not")


def test_hyperthreads_of_a_core_count_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_machine, "_affinity", lambda: {0, 1, 2, 3})
    pairs = {
        f"sys__devices__system__cpu__cpu{i}__topology__thread_siblings_list": f"{i % 2},{i % 2 + 2}" for i in range(4)
    }
    root = system(tmp_path, **pairs)
    assert doctor_machine.usable_cores(root) == 2
    assert "threads=1: there is no core to spare" in found("threads", doctor_machine.machine_findings(root)).found


def test_a_busy_machine_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    loads: Any = (1000.0, 0.0, 0.0)
    monkeypatch.setattr(os, "getloadavg", lambda: loads)
    assert found("load", doctor_machine.machine_findings()).level is Level.WARNING


def test_int8_without_integer_dot_products_is_a_warning(calibrated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ttscompile.artifact.manifest import Manifest
    from ttscompile.measure import machine

    monkeypatch.setattr(machine, "has_integer_dot_product", lambda: False)
    monkeypatch.setattr(Manifest, "precision_name", "int8")
    finding = found("precision", artifact_findings(calibrated))
    assert finding.level is Level.WARNING
    assert "'NAME@fp32'" in finding.remedy


def test_too_little_memory_is_a_problem(calibrated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ttscompile.doctor import target as doctor_artifact

    monkeypatch.setattr(doctor_artifact, "available_bytes", lambda: 1000)
    assert found("memory", artifact_findings(calibrated)).level is Level.PROBLEM
