"""Architecture: packages import from lower layers only, no file is too long, the top package exports public names."""

import ast
import re
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

import mkc_torch

ROOT = Path(mkc_torch.__file__).parent
MOST_LINES = 450

LAYERS = (
    {"_parallel", "_support"},
    {"density", "recording"},
    {"functional"},
    {"losses"},
    {"lightning", "linear", "metrics"},
    {"covariance", "nonlinear"},
    {"calibration", "effects"},
    {"simulation"},
    {"diagnosis"},
    {"report"},
    {"cli"},
)
"""Packages by layer, lowest first; a package imports from lower layers only."""


def module_of(path):
    parts = ("mkc_torch", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in sorted(ROOT.rglob("*.py"))}
PACKAGES = sorted(name for name, path in MODULES.items() if path.name == "__init__.py")


def imported(path):
    """Modules that a file imports anywhere, also in functions and for type checking."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            for name in node.names:
                whole = f"{node.module}.{name.name}"
                yield whole if whole in MODULES else node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


@cache
def imports():
    return {name: {module for module in imported(path) if module in MODULES} - {name} for name, path in MODULES.items()}


def nodes_in_cycles(graph):
    """Nodes that are part of a cycle."""
    reach = {node: set(ends) for node, ends in graph.items()}
    grown = True
    while grown:
        grown = False
        for ends in reach.values():
            more = set().union(*(reach.get(end, ()) for end in ends)) - ends
            ends |= more
            grown |= bool(more)
    return sorted(node for node, ends in reach.items() if node in ends)


def imports_between_children(package):
    """The import graph of the files and folders of a package."""
    graph = defaultdict(set)
    for name, ends in imports().items():
        if name.startswith(f"{package}."):
            own = name[len(package) + 1 :].split(".")[0]
            others = {end[len(package) + 1 :].split(".")[0] for end in ends if end.startswith(f"{package}.")}
            graph[own] |= others - {own}
    return graph


def test_no_file_has_circular_imports():
    assert nodes_in_cycles(imports()) == []


def test_files_and_folders_of_a_package_have_no_circular_imports():
    assert {
        package: found for package in PACKAGES if (found := nodes_in_cycles(imports_between_children(package)))
    } == {}


def test_every_package_has_a_layer():
    rooms = {
        path.stem for path in ROOT.iterdir() if (path.is_dir() and list(path.glob("*.py"))) or path.suffix == ".py"
    }
    assert rooms - {"__init__"} == set().union(*LAYERS)


def test_packages_import_only_from_lower_layers():
    graph, below = imports_between_children("mkc_torch"), set()
    for floor in LAYERS:
        for room in floor:
            assert graph[room] <= below, room
        below |= floor


def test_at_the_top_are_folders_and_the_public_functions():
    files = {path.name for path in ROOT.iterdir() if path.is_file()}
    assert files == {"__init__.py", "functional.py", "metrics.py", "py.typed"}


def test_no_file_is_too_long():
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in MODULES.items()}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_the_top_package_exports_public_names_alone():
    shown = dir(mkc_torch)
    assert not [name for name in shown if name.startswith("_")]
    rooms = {name.split(".")[1] for name in MODULES if name.count(".") == 1}
    assert set(shown) == set(mkc_torch.__all__) | {room for room in rooms if not room.startswith("_")}
    assert all(getattr(mkc_torch, name) is not None for name in shown)


def test_every_package_has_a_docstring():
    for name in PACKAGES:
        assert ast.get_docstring(ast.parse(MODULES[name].read_text(encoding="utf-8"))), name


def test_every_exported_name_exists():
    for name in PACKAGES:
        module = __import__(name, fromlist=["__all__"])
        assert [item for item in getattr(module, "__all__", ()) if not hasattr(sys.modules[name], item)] == []


def test_the_architecture_page_names_existing_files_and_every_package():
    text = (ROOT.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:[a-z_]+/)*[a-z_]+(?:/|\.py))`", text))
    there = {
        f"/{path.relative_to(ROOT.parent).as_posix()}" + "/" * path.is_dir()
        for path in [
            *ROOT.rglob("*"),
            *(ROOT.parent / "tests").rglob("*"),
            ROOT.parent / "tests",
            ROOT.parent / "examples",
            *(ROOT.parent / "examples").rglob("*"),
        ]
    }
    assert {name for name in named if not any(path.endswith(f"/{name}") for path in there)} == set()
    assert {f"{floor}/" for floors in LAYERS for floor in floors if (ROOT / floor).is_dir()} <= named


def test_no_test_of_the_diagnosis_patches_a_private_name():
    private = re.compile(r"""setattr\([^,()]*(?:,\s*["']|["'][\w.]*\.)_""")
    tests = sorted((ROOT.parent / "tests" / "diagnosis").rglob("*.py"))
    found = [path.name for path in tests if private.search(path.read_text(encoding="utf-8"))]
    assert not found
