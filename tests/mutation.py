"""Do the tests see a change of the code? `python -m tests.mutation density tests/density -n 40`

Each mutant is one change in one file of a room: an operator or a comparison exchanged, a number moved, a condition
turned round. The named tests run on a copy of the package with it, until one fails; a mutant that none fails on is
listed. Mutants are drawn by a seed; without `-n` all are tried. A library such as mutmut puts a switch into each
function, which torch.compile(fullgraph=True) cannot trace.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.MatMult: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult,
}
COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}


class Mutant(NamedTuple):
    """A file, the text it becomes, and the change in words."""

    path: Path
    text: str
    change: str


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that can be changed, in functions alone and outside of what they raise, whose words few tests read."""
    for function in ast.walk(tree):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            stack: list[ast.AST] = list(function.body)
            while stack:
                node = stack.pop()
                if isinstance(node, (ast.Raise, ast.FunctionDef, ast.AsyncFunctionDef, ast.JoinedStr)):
                    continue
                yield node
                annotated = isinstance(node, ast.AnnAssign)
                stack += [child for child in ast.iter_child_nodes(node) if not (annotated and child is node.annotation)]


def places(path: Path) -> list[tuple[Path, int]]:
    """A file, once for each of its mutants, and the number of the node that is changed."""
    nodes = list(_nodes(ast.parse(path.read_text(encoding="utf-8"))))
    return [(path, number) for number, node in enumerate(nodes) if _changed(node)]


def mutant_of(path: Path, number: int) -> Mutant:
    """The mutant of a file with this node changed."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    node = list(_nodes(tree))[number]
    before = ast.unparse(node)
    _changed(node)
    where = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
    return Mutant(path, ast.unparse(tree), f"{where}  {before}  ->  {ast.unparse(node)}")


def _changed(node: ast.AST) -> bool:
    """Change a node, if it is of a kind that is."""
    if isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in OPERATORS:
        node.op = OPERATORS[type(node.op)]()
    elif isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARISONS:
        node.ops[0] = COMPARISONS[type(node.ops[0])]()
    elif isinstance(node, ast.BoolOp):
        node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    elif isinstance(node, (ast.If, ast.IfExp, ast.While)):
        node.test = ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        node.value = not node.value
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        node.value = node.value + 1
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        node.op = ast.UAdd()
    else:
        return False
    return True


def survives(mutant: Mutant, package: Path, tests: list[str], seconds: float) -> bool:
    """Whether no test fails on a copy of the package with the mutant in it; one that takes too long is seen too."""
    target = package / mutant.path.relative_to(ROOT)
    own = target.read_text(encoding="utf-8")
    target.write_text(mutant.text, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(command, cwd=package, env=environment, capture_output=True, check=False, timeout=seconds)
        return done.returncode == 0
    except subprocess.TimeoutExpired:
        return False
    finally:
        target.write_text(own, encoding="utf-8")


def main() -> None:
    """Print each survivor, and the share that was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", help="folder or file of mkc_torch")
    parser.add_argument("tests", nargs="+", help="paths of the tests that should see a change")
    parser.add_argument("-n", type=int, default=0, help="how many are drawn; 0 tries all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=300.0, help="that the tests of one mutant may take")
    asked = parser.parse_args()
    room = ROOT / "mkc_torch" / asked.room
    files = sorted(room.rglob("*.py")) if room.is_dir() else [room]
    found = [place for file in files for place in places(file)]
    if asked.n:
        found = random.Random(asked.seed).sample(found, min(asked.n, len(found)))
    left = 0
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder)
        for name in ("mkc_torch", "tests", "pyproject.toml"):
            (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, package / name)
        for number, (path, node) in enumerate(found, start=1):
            mutant = mutant_of(path, node)
            if survives(mutant, package, asked.tests, asked.seconds):
                left += 1
                print(f"survives: {mutant.change}", flush=True)
            elif number % 10 == 0:
                print(f"{number} of {len(found)} tried, {left} survive", flush=True)
    print(f"{len(found) - left} of {len(found)} were seen, {100 * (1 - left / max(len(found), 1)):.0f} %")


if __name__ == "__main__":
    main()
