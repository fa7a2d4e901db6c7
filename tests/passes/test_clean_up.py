"""Simplification of every graph of a program."""

import pytest

from tests.passes.modules import compiled
from ttscompile.ir.program import Program
from ttscompile.passes.clean_up import CleanUp


@pytest.mark.slow
def test_clean_up_is_idempotent() -> None:
    _, program = compiled("tokens")
    assert CleanUp[Program]()(program).program is program
