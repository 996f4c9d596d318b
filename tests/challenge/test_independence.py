"""The generator is an independent witness: it knows nothing of what it tests."""

import ast
import sys
from pathlib import Path

import pytest

import mkc_torch.challenge

FOLDER = Path(mkc_torch.challenge.__file__).parent
FORBIDDEN = ("effects", "diagnosis", "simulation", "nonlinear")
GIVEN_AWAY = {FOLDER / "dynamics" / "nominal_models.py", FOLDER / "dynamics" / "scenarios" / "wrong_simulations.py"}
"""What a user would have written: material for the diagnosis, of which the generator knows the place alone."""

ALLOWED = {"mkc_torch", "torch", "numpy", "jaxtyping", "jinja2", "markupsafe", "matplotlib", "__future__"}


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


@pytest.mark.parametrize("path", sorted({*FOLDER.rglob("*.py")} - GIVEN_AWAY), ids=lambda path: path.stem)
def test_imports_nothing_of_what_it_tests(path):
    for module in imported(path):
        assert module.rpartition(".")[2] not in {given.stem for given in GIVEN_AWAY}
        assert not any(f".{given.stem}." in module for given in GIVEN_AWAY)
        parts = module.split(".")
        assert parts[0] in ALLOWED or parts[0] in sys.stdlib_module_names
        assert not (parts[0] == "mkc_torch" and len(parts) > 1 and parts[1] in FORBIDDEN)
