"""The fingerprint of the machine: enough to judge a timing by, nothing that says whose machine it is."""

from __future__ import annotations

import getpass
import json
import platform

from ttscompile.machine import fingerprint, one_line


def test_the_fingerprint_is_json_and_names_what_decides_a_timing() -> None:
    machine = fingerprint()
    assert json.loads(json.dumps(machine)) == machine
    assert machine["cores"] >= 1
    assert machine["memory_gib"] > 0
    assert machine["onnxruntime"] in one_line(machine)


def test_the_fingerprint_names_neither_machine_nor_user() -> None:
    values = {str(value) for value in fingerprint().values()}
    assert values.isdisjoint({platform.node(), getpass.getuser()})
