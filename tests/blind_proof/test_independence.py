"""The generator is an independent witness: it knows nothing of what it tests."""

import ast
import sys
from pathlib import Path

import pytest

import examples.blind_proof

FOLDER = Path(examples.blind_proof.__file__).parent
FORBIDDEN = ("effects", "diagnosis", "simulation", "nonlinear", "cli")
GIVEN_AWAY = FOLDER / "equations" / "models.py"
"""Simulations as a user writes them: material for the diagnosis, of which the generator knows the file name only."""

COMMAND = {FOLDER / "__main__.py", FOLDER / "diagnose.py"}
"""The files that run what is tested."""

ALLOWED = {"examples", "mkc_torch", "torch", "numpy", "jaxtyping", "jinja2", "markupsafe", "matplotlib", "__future__"}


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


@pytest.mark.parametrize("path", sorted({*FOLDER.rglob("*.py")} - {GIVEN_AWAY} - COMMAND), ids=lambda path: path.stem)
def test_imports_nothing_of_what_it_tests(path):
    for module in imported(path):
        assert not module.endswith(("equations.models", "blind_proof.diagnose"))
        parts = module.split(".")
        assert parts[0] in ALLOWED or parts[0] in sys.stdlib_module_names
        assert not (parts[0] == "mkc_torch" and len(parts) > 1 and parts[1] in FORBIDDEN)
