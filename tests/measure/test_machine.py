"""The fingerprint of the machine: enough to judge a timing by, nothing that says whose machine it is."""

from __future__ import annotations

import getpass
import json
import platform
from pathlib import Path
from typing import Any

import pytest

from ttscompile.measure import machine
from ttscompile.measure.machine import fingerprint, one_line


def test_the_fingerprint_is_json_and_names_what_decides_a_timing() -> None:
    found = fingerprint()
    assert json.loads(json.dumps(found)) == found
    assert found["cores"] >= 1
    assert found["memory_gib"] > 0
    assert found["onnxruntime"] in one_line(found)


def test_the_fingerprint_names_neither_machine_nor_user() -> None:
    values = {str(value) for value in fingerprint().values()}
    assert values.isdisjoint({platform.node(), getpass.getuser()})


@pytest.mark.parametrize(
    ("processor", "cpuinfo", "expected"),
    [
        ("x86_64", "flags\t\t: fpu avx2 avx512_vnni\n", True),
        ("x86_64", "flags\t\t: fpu avx2 avx_vnni\n\nprocessor: 1\nflags: fpu\n", True),
        ("AMD64", "flags\t\t: fpu avx2 avx512f\n", False),
        ("x86_64", "flags\t\t: fpu my_avx512_vnni_like\n", False),
        ("x86_64", "model name: unknown\n", None),
        ("x86_64", None, None),
        ("aarch64", "Features\t: fp asimd\n", True),
    ],
)
def test_integer_dot_products_are_read_from_the_flags(
    processor: str, cpuinfo: str | None, expected: bool | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if cpuinfo is not None:
        (tmp_path / "cpuinfo").write_text(cpuinfo)
    monkeypatch.setattr(machine, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(platform, "machine", lambda: processor)
    assert machine.has_integer_dot_product() is expected


def test_a_busy_machine_is_named_with_its_load(monkeypatch: pytest.MonkeyPatch) -> None:
    loads: Any = (0.0, 0.0, 0.0)
    monkeypatch.setattr("os.getloadavg", lambda: loads)
    assert machine.busy() is None
    loads = (1000.0, 0.0, 0.0)
    warning = machine.busy()
    assert warning is not None
    assert "load 1000" in warning
