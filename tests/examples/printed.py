"""What a table looks like in a terminal."""

import io
from typing import Any

from rich.console import Console


def printed(table: Any, width: int = 200) -> list[str]:
    """Its lines."""
    shown = io.StringIO()
    Console(file=shown, width=width).print(table)
    return shown.getvalue().splitlines()
