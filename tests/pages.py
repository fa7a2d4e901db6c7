"""The pages of the documentation, and scripts that are no part of a package."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
EXTENDING = ROOT / "docs" / "extending"


def there(name: str) -> bool:
    """Whether ``tests/file.py::test_name`` is a test."""
    file, _, function = name.partition("::")
    path = ROOT / file
    if not path.is_file():
        return False
    made = ast.walk(ast.parse(path.read_text()))
    return any(isinstance(node, ast.FunctionDef) and node.name == function for node in made)


def load(path: Path, name: str) -> ModuleType:
    """A script that is no part of a package."""
    found = importlib.util.spec_from_file_location(name, path)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module
    found.loader.exec_module(module)
    return module


examples = load(ROOT / "docs" / "examples.py", "docs_examples")
