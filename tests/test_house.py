"""The rules of the house: which way imports go, what the robot must not need, how long a file may be."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

import ttscompile

from .imports import PACKAGES, Import, eager_closure, home, imports, imports_by_name, modules
from .structure import FLOORS, arrows_up, by_name_of, circles, doors_of, drawing

ROOT = Path(__file__).resolve().parents[1]
MODULES = modules(ROOT)

BASE = {"core", "errors", "measure"}
"""What everything may import; neither knows more than the other parts of this set."""

BELOW_ARTIFACT = BASE | {"ir", "artifact"}
MAY_IMPORT = {
    "errors": set(),
    "core": {"errors"},
    "measure": {"errors"},
    "plots": BASE,
    "samplers": BASE,
    "trajectories": BASE | {"hub"},
    "hub": BASE,
    "ir": BASE,
    "lower": BASE | {"ir"},
    "passes": BASE | {"ir"},
    "frontends": BASE | {"hub", "samplers"},
    "policies": BASE | {"frontends", "hub", "samplers"},
    "capture": BASE | {"frontends", "ir"},
    "artifact": BASE | {"ir"},
    "runtimes": BELOW_ARTIFACT | {"hub"},
    "doctor": BELOW_ARTIFACT | {"frontends", "hub", "runtimes", "trajectories"},
    "verification": BELOW_ARTIFACT | {"frontends", "runtimes", "trajectories"},
    "pool": BASE | {"artifact"},
    "calibration": BELOW_ARTIFACT | {"lower", "pool", "runtimes", "trajectories", "verification"},
    "builder": BELOW_ARTIFACT | {"calibration", "driver", "frontends", "runtimes", "trajectories"},
    "rivals": BELOW_ARTIFACT | {"calibration", "runtimes"},
    "serving": BELOW_ARTIFACT | {"cli", "runtimes"},
    "report": BELOW_ARTIFACT | {"hub", "plots", "runtimes", "trajectories", "verification"},
    "driver": BELOW_ARTIFACT | {"capture", "frontends", "hub", "lower", "passes", "runtimes", "verification"},
    "cli": BELOW_ARTIFACT
    | {"calibration", "doctor", "driver", "frontends", "plots", "report", "runtimes", "trajectories", "verification"},
}
"""Part of the package -> the other parts that it may import, anywhere in its code. Design, section 4."""

RIVALS_READ = {
    f"ttscompile.calibration.{name}" for name in ("calls", "proposer", "pruner.paper", "runner", "step_counts", "task")
}
"""What rivals know of calibration: their rows, what a search is given and may compare, and how a head is trained."""

MOST_DOORS = 12
"""Other rooms that a room may import: a reader who opens more of them at once is lost."""

COMPILERS_ONLY = {"diffusers", "matplotlib", "onnx", "onnx_ir", "onnxscript", "pydantic", "safetensors", "torch"}
COMPILES = (
    "ttscompile.builder",
    "ttscompile.calibration",
    "ttscompile.capture",
    "ttscompile.driver",
    "ttscompile.frontends",
    "ttscompile.policies",
    "ttscompile.ir.evaluate",
    "ttscompile.ir.idle_form",
    "ttscompile.ir.tokens",
    "ttscompile.lower",
    "ttscompile.passes",
    "ttscompile.rivals",
    "ttscompile.runtimes.reference",
    "ttscompile.runtimes.torch",
    "ttscompile.samplers",
    "ttscompile.verification.record_golden",
)
"""Modules that may need the compiler's dependencies when they are imported; nothing else may, not even indirectly."""


def part(module: str) -> str:
    """``ttscompile.ir.graph`` -> ``ir``, ``ttscompile`` -> nothing."""
    return module.removeprefix("ttscompile").lstrip(".").partition(".")[0]


@cache
def graph() -> dict[str, list[Import]]:
    """What each module imports."""
    return {name: imports(name, path) for name, path in MODULES.items()}


def direction_errors(found: list[Import], known: set[str]) -> list[str]:
    """Imports against the direction, one line each."""
    errors = []
    for each in found:
        target = home(each.target, known)
        if target is None or target == "ttscompile":  # the package itself has the public names
            continue
        importer, imported = part(each.importer), part(target)
        if importer not in {"", "__main__", imported} and imported not in MAY_IMPORT[importer]:
            errors.append(f"{each.importer}:{each.line} imports {target}: {importer} must not know {imported}")
        if importer == "rivals" and imported == "calibration" and target not in RIVALS_READ:
            errors.append(f"{each.importer}:{each.line} imports {target}: rivals know {sorted(RIVALS_READ)}")
        if importer == imported == "passes" and target not in {"ttscompile.passes.base", "ttscompile.passes"}:
            errors.append(f"{each.importer}:{each.line} imports {target}: passes do not import each other")
    return errors


def compiles(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in COMPILES)


def test_every_part_of_the_package_has_its_place_in_the_direction() -> None:
    assert {part(name) for name in MODULES} - {"", "__main__"} == set(MAY_IMPORT)


def test_imports_go_one_way() -> None:
    found = [each for each_module in graph().values() for each in each_module]
    assert len(found) > 100, "the walk over the source found hardly anything"
    assert direction_errors(found, set(MODULES)) == []


def test_rivals_read_what_is_listed() -> None:
    read = {home(each.target, MODULES) for name, found in graph().items() if part(name) == "rivals" for each in found}
    assert read >= RIVALS_READ, "rivals read less: shorten the list"


def test_no_modules_import_each_other() -> None:
    """Not even in functions, or for types alone: what depends on each other is one module, or is cut elsewhere."""
    ahead = {
        name: {target: 1 for each in found if (target := home(each.target, MODULES)) not in (None, name)}
        for name, found in graph().items()
    }
    assert circles(ahead) == []


@pytest.mark.parametrize(
    ("importer", "target"),
    [
        ("ttscompile.ir.graph", "ttscompile.passes.hoist"),
        ("ttscompile.passes.hoist", "ttscompile.runtimes.runtime"),
        ("ttscompile.passes.hoist", "ttscompile.passes.partition"),
        ("ttscompile.runtimes.runtime", "ttscompile.frontends"),
        ("ttscompile.runtimes.runtime", "ttscompile.calibration"),
        ("ttscompile.runtimes.executor.executor", "ttscompile.serving.listener"),
        ("ttscompile.artifact.load", "ttscompile.runtimes.load.load"),
        ("ttscompile.errors", "ttscompile.core.spec"),
        ("ttscompile.driver", "ttscompile.cli"),
        ("ttscompile.calibration.tts", "ttscompile.rivals.bac"),
        ("ttscompile.rivals.bac", "ttscompile.calibration.pipeline"),
        ("ttscompile.frontends.families", "ttscompile.policies.octo"),
        ("ttscompile.pool", "ttscompile.calibration.runner"),
    ],
)
def test_an_import_the_wrong_way_is_found(importer: str, target: str) -> None:
    known = {importer, target, "ttscompile", "ttscompile.runtimes.policy"}
    assert len(direction_errors([Import(importer, target, 1, True)], known)) == 1


def test_the_rooms_stand_on_floors_without_circles_and_have_at_most_twelve_doors() -> None:
    doors = doors_of()
    assert sorted(doors) == sorted(name for floor in FLOORS for name in floor)
    assert circles(doors) == []
    assert arrows_up(doors) == []
    assert {name: sorted(targets) for name, targets in doors.items() if len(targets) > MOST_DOORS} == {}


def test_circles_and_arrows_up_are_found_and_drawn() -> None:
    doors = {name: dict[str, int]() for floor in FLOORS for name in floor}
    doors["cli"]["core"] = 1
    assert (circles(doors), arrows_up(doors)) == ([], [])
    doors["core"]["ir"], doors["ir"]["artifact"], doors["artifact"]["core"] = 1, 2, 3
    assert circles(doors) == [("artifact", "core", "ir")]
    assert arrows_up(doors) == ["core -> ir (1 imports)", "ir -> artifact (2 imports)"]
    assert "circles: artifact - core - ir\narrows up: core -> ir (1 imports); ir" in drawing(doors)


@pytest.mark.slow
def test_the_drawing_can_be_had_as_a_command() -> None:
    result = subprocess.run([sys.executable, ROOT / "tests" / "structure.py"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    named = "calibration -> rivals (1); cli -> serving (1); frontends -> policies (1)"
    assert result.stdout.endswith(f"by name: {named}\ncircles: none\narrows up: none\n")


def test_what_is_attached_is_loaded_by_name_from_one_place_each_and_is_a_floor_up() -> None:
    found = [(room, target, places) for room, targets in by_name_of().items() for target, places in targets.items()]
    assert sorted(found) == [("calibration", "rivals", 1), ("cli", "serving", 1), ("frontends", "policies", 1)]
    floor = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
    assert all(floor[target] > floor[room] for room, target, _ in found)
    assert {f"plugins/{target}" for _, target, _ in found} < set(PACKAGES)


def test_names_that_are_loaded_are_resolved_as_far_as_the_text_tells(tmp_path: Path) -> None:
    path = tmp_path / "one.py"
    path.write_text(
        "import_module('ttscompile.serving.command').serve\n"
        "importlib.import_module(f'..policies.{name}', __package__)\n"
        "pkgutil.resolve_name('ttscompile.rivals:RIVALS'); pkgutil.resolve_name(f'ttscompile.{maker}')\n"
        "import_module(f'{__package__}.fused'); import_module('numpy'); import_module(name)\n"
        "ROW = Row('calibration.tts:Tts', 'of a task: Text')\n"
    )
    assert sorted(filter(None, imports_by_name("ttscompile.frontends.one", path))) == [
        "numpy",
        "ttscompile.calibration.tts",
        "ttscompile.frontends.fused",
        "ttscompile.policies",
        "ttscompile.rivals",
        "ttscompile.serving.command",
    ]


@pytest.mark.slow
def test_the_residual_stream_is_never_the_stream_and_the_glossary_has_each_word_once() -> None:
    """A batch has streams, too: each is called by its own word (design, section 1)."""
    texts = [*MODULES.values(), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    found = {path: re.findall(r".*\bthe stream\b.*", path.read_text(), re.IGNORECASE) for path in texts}
    assert {str(path): lines for path, lines in found.items() if lines and path.name != "design.md"} == {}
    words = (ROOT / "docs" / "design.md").read_text().partition("\n## 2. ")[0]
    rows = re.findall(r"^\| ([a-z][^|]*?) \|", words, re.MULTILINE)
    assert sorted(set(rows) - {"word"}) == sorted(row for row in rows if row != "word")


def test_the_core_has_at_most_42000_lines() -> None:
    """``find ttscompile passes runtimes -name "*.py" | xargs cat | wc -l``: who adds to it takes away elsewhere."""
    files = [path for folder in ("ttscompile", "passes", "runtimes") for path in (ROOT / folder).rglob("*.py")]
    assert sum(path.read_bytes().count(b"\n") for path in files) <= 42_000


def leaving(module: str, source: str) -> list[int]:
    """Lines of a module of ``passes`` or ``runtimes`` where a relative import leads out of that package."""
    inside = module.count(".") - 1
    tree = ast.walk(ast.parse(source))
    return [node.lineno for node in tree if isinstance(node, ast.ImportFrom) and node.level > inside]


def test_passes_and_runtimes_import_what_is_outside_of_them_by_whole_names() -> None:
    """Their folders stand at the top of the tree: ``from ..`` would lead out of it where tools read it as it stands."""
    assert leaving("ttscompile.runtimes.base", "from ..errors import X") == [1]
    assert leaving("ttscompile.runtimes.executor.state", "from ..base import X\nfrom ...errors import X") == [2]
    for name, path in MODULES.items():
        if part(name) in ("policies", "passes", "rivals", "runtimes", "serving"):
            depth = name if path.name != "__init__.py" else f"{name}.__init__"
            assert leaving(depth, path.read_text()) == [], name


def test_the_runtime_side_needs_nothing_of_the_compilers() -> None:
    light = [name for name in MODULES if not compiles(name)]
    assert "ttscompile.runtimes.runtime" in light
    for name in light:
        chains = eager_closure(name, graph())
        heavy = {foreign: " -> ".join(chain) for foreign, chain in chains.items() if foreign in COMPILERS_ONLY}
        assert heavy == {}


def test_the_closure_sees_through_modules_and_parents_but_not_into_functions(tmp_path: Path) -> None:
    folder = tmp_path / "ttscompile"
    (folder / "inner").mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "a.py").write_text("from .inner import deep\n")
    (folder / "inner" / "__init__.py").write_text("try:\n    import torch.nn\nexcept ImportError:\n    pass\n")
    (folder / "inner" / "deep.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import onnx\ndef f():\n    import diffusers\n"
    )
    graph = {name: imports(name, path) for name, path in modules(tmp_path).items()}
    chains = eager_closure("ttscompile.a", graph)
    assert "torch" in chains
    assert {"onnx", "diffusers"}.isdisjoint(chains)


def test_every_pass_has_its_test_and_tests_import_helpers_not_each_other() -> None:
    passes = {p.stem for p in (ROOT / "passes").glob("*.py")} - {"__init__", "base"}
    assert {f"test_{name}.py" for name in passes} <= {p.name for p in (ROOT / "tests" / "passes").iterdir()}
    found: dict[str, list[str]] = {}
    for path in (ROOT / "tests").rglob("*.py"):
        lines = re.findall(r"^\s*(?:from|import) [\w.]*\btest_\w+.*", path.read_text(), re.MULTILINE)
        own = [line for line in lines if f"{path.stem} import" not in line]  # in a process of its own
        found |= {str(path.relative_to(ROOT)): own} if own else {}
    assert found == {}


BESIDE_ROOMS = {"examples", "families", "hostile", "machines", "plugins"}
"""Folders of tests that are of no room: of what is beside the package, or goes through all of it."""


def test_folders_of_tests_are_rooms() -> None:
    folders = {path.parent.name for path in (ROOT / "tests").glob("*/test_*.py")} - BESIDE_ROOMS
    assert folders <= set(MAY_IMPORT)
    inside = {path.parent.name for path in (ROOT / "tests" / "runtimes").glob("*/test_*.py")}
    assert inside <= {path.name for path in (ROOT / "runtimes").iterdir()}


def test_files_are_short() -> None:
    files = [p for top in (*PACKAGES, "tests", "examples") for p in (ROOT / top).rglob("*.py")]
    lengths = {str(p.relative_to(ROOT)): len(p.read_text().splitlines()) for p in files}
    assert {name: n for name, n in lengths.items() if n >= 400} == {}


def test_every_package_is_installed() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    assert sorted(listed) == sorted(name for name, path in MODULES.items() if path.name == "__init__.py")


def test_every_public_name_can_be_had_and_an_unknown_one_is_explained() -> None:
    for name in ttscompile.__all__:
        assert getattr(ttscompile, name) is not None
    assert set(ttscompile.__all__) <= set(dir(ttscompile))
    with pytest.raises(AttributeError, match="no attribute 'compile'; it has .*convert"):
        ttscompile.compile  # noqa: B018


def test_a_command_that_is_attached_can_be_imported_first(tmp_path: Path) -> None:
    """Where no folder has the package's name: a clone mostly has it, and is no package."""
    code = "import ttscompile.serving.command as one, ttscompile.cli as cli; print(cli.main.commands[one.serve.name])"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


def test_importing_the_package_loads_neither_numpy_nor_torch(tmp_path: Path) -> None:
    heavy = "{'numpy', 'torch', 'onnx', 'onnxruntime'}"
    code = f"import sys, ttscompile; assert ttscompile.__file__; print(sorted({heavy} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert result.stdout == "[]\n"


def anchors(page: str) -> set[str]:
    """What a link may name in a page of Markdown: its titles in small letters, with hyphens."""
    titles = re.findall(r"^#+ (.+)$", page, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


def leads_somewhere(link: str) -> bool:
    """Whether a relative link of the README names a file of the tree and, after #, a title in it."""
    file, _, anchor = link.partition("#")
    page = ROOT / (file or "README.md")
    return page.exists() and (not anchor or anchor in anchors(page.read_text()))


def test_readme_is_finished_and_its_links_lead_somewhere() -> None:
    text = (ROOT / "README.md").read_text()
    assert not re.findall(r"@[A-Z]+@", text)
    links = [link for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]
    assert links
    assert [link for link in links if not leads_somewhere(link)] == []
    assert not leads_somewhere("docs/nothing.md")
    assert not leads_somewhere("#no-such-title")
