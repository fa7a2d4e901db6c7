"""Who imports whom, read from the source without running it."""

from __future__ import annotations

import ast
import re
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

PACKAGES = {
    "ttscompile": "ttscompile",
    "passes": "ttscompile.passes",
    "runtimes": "ttscompile.runtimes",
    "plugins/doctor": "ttscompile.doctor",
    "plugins/hub": "ttscompile.hub",
    "plugins/policies": "ttscompile.policies",
    "plugins/rivals": "ttscompile.rivals",
    "plugins/serving": "ttscompile.serving",
}
"""Folder of the tree -> package that it is installed as."""


@dataclass(frozen=True)
class Import:
    """One import of one module.

    Attributes:
        importer: full name of the importing module.
        target: full name of what is imported; ``from a import b`` gives ``a.b``, which may be a name in ``a``.
        line: in the importer's file.
        eager: executed when the importer is: not in a function, nor under ``TYPE_CHECKING``.
    """

    importer: str
    target: str
    line: int
    eager: bool


def modules(root: Path) -> dict[str, Path]:
    """Every module of the package, by the name under which it is installed."""
    found = {}
    for folder, package in PACKAGES.items():
        for path in sorted((root / folder).rglob("*.py")):
            parts = [package, *path.relative_to(root / folder).with_suffix("").parts]
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(name: str, path: Path) -> list[Import]:
    """All imports of one module, relative ones resolved."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    return [
        Import(name, target, node.lineno, eager)
        for node, eager in _import_nodes(ast.parse(path.read_text()), eager=True)
        for target in _targets(node, package)
    ]


def imports_by_name(name: str, path: Path) -> list[str]:
    """What a module loads by a text, or has in a table as ``room.module:Name``, resolved.

    Of a text that is put together, what comes before its first part that only a run can tell; nothing where that is the
    whole package.
    """
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    own, found = {"__package__": package, "__name__": name}, []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and node.args and ast.unparse(node.func).rpartition(".")[2] in _LOADERS:
            text = _known_text(node.args[0], own).partition(":")[0]
            dots = len(text) - len(text.lstrip("."))
            anchor = package.split(".")[: len(package.split(".")) + 1 - dots] if dots else []
            found.append(".".join([*anchor, *filter(None, text.split("."))]))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _ROW.fullmatch(node.value):
            found.append(f"ttscompile.{node.value.partition(':')[0]}")
    return [target for target in found if target != "ttscompile"]


def home(target: str, known: Container[str]) -> str | None:
    """The module of the package that ``target`` is, or is a name in; None for somebody else's."""
    while target:
        if target in known:
            return target
        target = target.rpartition(".")[0]
    return None


def eager_closure(start: str, graph: dict[str, list[Import]]) -> dict[str, list[str]]:
    """What importing ``start`` executes: every module, own or foreign, with the chain of modules that leads to it."""
    chains: dict[str, list[str]] = {}
    pending = [(start, [start])]
    while pending:
        name, chain = pending.pop()
        if name in chains:
            continue
        chains[name] = chain
        for imported in graph.get(name, []):
            if imported.eager:
                target = home(imported.target, graph.keys()) or imported.target.partition(".")[0]
                pending.append((target, [*chain, target]))
        # Importing a.b.c executes a and a.b first.
        parent = name.rpartition(".")[0]
        if parent in graph:
            pending.append((parent, [*chain, parent]))
    return chains


_LOADERS = ("import_module", "resolve_name")
_ROW = re.compile(r"(?!ttscompile)[a-z]\w*(\.\w+)*:[A-Z]\w*")


def _known_text(node: ast.expr, own: Mapping[str, str]) -> str:
    text = ""
    for part in node.values if isinstance(node, ast.JoinedStr) else [node]:
        told = part.value if isinstance(part, ast.Constant) else own.get(ast.unparse(part).strip("{f'\"}"))
        if not isinstance(told, str):
            break
        text += told
    return text


def _import_nodes(tree: ast.AST, eager: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, eager
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from _import_nodes(ast.Module(node.body, []), eager=False)
            yield from _import_nodes(ast.Module(node.orelse, []), eager)
        elif not isinstance(node, ast.expr):  # in which nothing is imported, and which most nodes are
            inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from _import_nodes(node, eager and not inside)


def _targets(node: ast.Import | ast.ImportFrom, package: str) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    base = node.module or ""
    if node.level:
        anchor = package.split(".")[: len(package.split(".")) - node.level + 1]
        base = ".".join([*anchor, *([node.module] if node.module else [])])
    return [f"{base}.{alias.name}" for alias in node.names]
