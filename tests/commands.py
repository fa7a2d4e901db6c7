"""Commands, run in this process as somebody types them."""

import json
from typing import Any

from click.testing import CliRunner, Result

from ttscompile.cli import main


def run(*words: object) -> Result:
    """Whatever its status."""
    return CliRunner().invoke(main, [str(word) for word in words], catch_exceptions=False)


def done(*words: object) -> Result:
    """What ends with status 0."""
    result = run(*words)
    assert result.exit_code == 0, result.stderr
    return result


def as_json(*words: object) -> Any:
    """What it prints with ``--json``."""
    return json.loads(done(*words, "--json").stdout)


def refused(*words: object) -> str:
    """What bad usage or bad input is told, on one line: status 2, no results and no traceback."""
    result = run(*words)
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    assert "Traceback" not in result.stderr
    return " ".join(result.stderr.split())
