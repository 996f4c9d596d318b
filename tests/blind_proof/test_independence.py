"""The generator of the blind proof is independent of the code under test."""

import ast
import sys
from pathlib import Path

import pytest

import examples.blind_proof

FOLDER = Path(examples.blind_proof.__file__).parent
FORBIDDEN = ("effects", "diagnosis", "simulation", "nonlinear", "cli")
USER_SIMULATIONS = FOLDER / "equations" / "models.py"
"""Simulations as a user writes them; the generator uses the file name only."""

DIAGNOSIS_RUNNERS = {FOLDER / "__main__.py", FOLDER / "diagnose.py"}
"""The files that run the code under test."""

ALLOWED = {
    *("examples", "mkc_torch", "torch", "numpy", "jaxtyping", "jinja2", "markupsafe", "matplotlib", "__future__"),
    "mujoco",
}


def imported_modules(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


@pytest.mark.parametrize(
    "path", sorted({*FOLDER.rglob("*.py")} - {USER_SIMULATIONS} - DIAGNOSIS_RUNNERS), ids=lambda path: path.stem
)
def test_the_generator_imports_no_module_under_test(path):
    for module in imported_modules(path):
        assert not module.endswith(("equations.models", "blind_proof.diagnose"))
        parts = module.split(".")
        assert parts[0] in ALLOWED or parts[0] in sys.stdlib_module_names
        assert not (parts[0] == "mkc_torch" and len(parts) > 1 and parts[1] in FORBIDDEN)
