"""A configuration in YAML that another program wrote, read without anchors, objects or more than is plain."""

from pathlib import Path
from typing import Any

import yaml

from ttscompile.errors import CheckpointError

MAX_BYTES = 2**18
"""Of a configuration; in use is 1 KB."""


class _Plain(yaml.SafeLoader):  # type: ignore[misc]  # it comes without types
    """Mappings, lists and scalars; no alias, since some lines of those can stand for any number of entries."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse an alias, and go on as usual."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"an alias ({self.peek_event().anchor})")
        return super().compose_node(parent, index)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a file holds."""
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise CheckpointError(f"{path}: larger than {MAX_BYTES} bytes; expected a configuration. Copy it again.")
        data = yaml.load(text, Loader=_Plain)  # noqa: S506  # a safe one
    except CheckpointError:
        raise
    except Exception as error:  # damaged text fails in the scanner, in numbers and dates, or in the depth of Python
        told = " ".join(str(error).split())
        raise CheckpointError(f"{path}: cannot be read as plain YAML: {told:.300}. Copy the file again.") from error
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        raise CheckpointError(f"{path}: holds a {type(data).__name__}; expected settings by name. Copy it again.")
    return data
