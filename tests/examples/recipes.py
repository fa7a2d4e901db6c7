"""The recipes of trained policies, as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def script(folder: Path, name: str) -> ModuleType:
    """Loaded under a name of its own: other folders of examples have scripts of the same names.

    What it puts into the path is taken out again: the folder beside it would pass for the package metaworld.
    """
    spec = importlib.util.spec_from_file_location(f"{folder.name}_{name}", folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    path = list(sys.path)
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path[:] = path
    return module
