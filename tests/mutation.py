"""Mutation testing: `python -m tests.mutation density tests/density -n 40`

Each mutant is a single change in a file of a package: an operator or a comparison exchanged, a number changed, a
condition negated. The named tests run once under coverage; then those that reach the changed statement run on a copy of
the package with the mutant in it, the quickest first, until one fails. A mutant that no test detects is listed; a
mutant that no test reaches is tried with all tests. Mutants are drawn by a seed; without `-n` all are tried. A library
such as mutmut puts a switch into each function, which torch.compile(fullgraph=True) cannot trace.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import contextlib
import importlib
import os
import pickle
import py_compile
import random
import resource
import shutil
import signal
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PYTEST = ("-q", "-m", "not slow", "--doctest-modules", "-p", "no:cacheprovider", "--assert=plain")  # rewriting is slow
LOADED = ("torch", "torch._dynamo", "numpy", "scipy.stats", "scipy.optimize", "hypothesis", "sklearn.linear_model")
SLACK = 30  # seconds that a test may take beyond five times what it takes under coverage
OUTPUT = Path("output.txt")  # in the copy: what the last tests wrote
MEMORY = 16 << 30  # limit of the address space of a mutant, bytes
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
    """A file of the copy, its mutated text, a description of the change, and the lines of the changed statement."""

    path: Path
    text: str
    change: str
    lines: range


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that can be changed: in functions, outside of raised errors, whose wording few tests check."""
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


def mutation_sites(path: Path) -> list[tuple[Path, int]]:
    """The file and the number of the changed node of each of its mutants."""
    nodes = list(_nodes(ast.parse(path.read_text(encoding="utf-8"))))
    return [(path, number) for number, node in enumerate(nodes) if _changed(node)]


def mutant_of(path: Path, number: int) -> Mutant:
    """The mutant of a file with the node of this number changed."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    node = list(_nodes(tree))[number]
    before, lines = ast.unparse(node), _lines_of_statement(tree, node)
    _changed(node)
    where = f"{path}:{getattr(node, 'lineno', 0)}"
    return Mutant(path, ast.unparse(tree), f"{where}  {before}  ->  {ast.unparse(node)}", lines)


def _lines_of_statement(tree: ast.AST, node: ast.AST) -> range:
    """Lines of the innermost statement around a node, without nested statements."""
    statements = [entry for entry in ast.walk(tree) if isinstance(entry, ast.stmt)]
    inner = [entry for entry in statements if any(each is node for each in ast.walk(entry))]
    statement = inner[-1]  # ast.walk goes from the outside inwards
    body = getattr(statement, "body", [])
    return range(statement.lineno, body[0].lineno if body else statement.end_lineno + 1)


def _changed(node: ast.AST) -> bool:
    """Change a node in place. Returns whether its kind can be changed."""
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


class Reach(NamedTuple):
    """Tests or test files by the (file, line) that they run, and the seconds of each test."""

    by_line: dict[tuple[str, int], set[str]]
    seconds: dict[str, float]

    def tests_of(self, mutant: Mutant) -> list[str]:
        """Tests that run the statement of a mutant, the quickest first."""
        found = set().union(*(self.by_line.get((str(mutant.path), line), set()) for line in mutant.lines))
        tests = [test for test in self.seconds if test in found or test.split("::")[0] in found]
        return sorted(tests, key=self.seconds.__getitem__)


class _Recorder:
    """A pytest plugin that reports the running test to coverage; a fixture's lines count for every test of its file."""

    def __init__(self, coverage: Any) -> None:
        self.coverage = coverage
        self.seconds: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        self.coverage.switch_context(item.nodeid.split("::")[0])
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        self.coverage.switch_context(item.nodeid)
        return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration


class _TimeLimit:
    """A pytest plugin that ends the process when a test exceeds five times its seconds by ``SLACK``."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds = seconds

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        signal.alarm(SLACK + int(5 * self.seconds.get(item.nodeid, 0.0)))
        return (yield)


def reach_of(tests: list[str]) -> Reach:
    """Run the tests on the unchanged copy, and record the lines that each runs."""
    pickled = Path("reach.pickle")

    def record() -> int:
        from coverage import Coverage

        coverage = Coverage(data_file=None, source=["mkc_torch"], config_file=False)
        recorder = _Recorder(coverage)
        coverage.start()
        done = pytest.main([*PYTEST, *tests], plugins=[recorder])
        coverage.stop()
        data, by_line = coverage.get_data(), defaultdict(set)
        for file in data.measured_files():
            path = str(Path(file).relative_to(Path.cwd()))
            for line, contexts in data.contexts_by_lineno(file).items():
                by_line[path, line] |= set(contexts) - {""}
        pickled.write_bytes(pickle.dumps((dict(by_line), recorder.seconds)))
        return int(done)

    if status := _in_a_child_process(record):
        output = OUTPUT.read_text(encoding="utf-8", errors="replace")[-3000:]
        raise SystemExit(f"{output}\nthe tests fail on the code as it is, or under coverage (status {status})")
    return Reach(*pickle.loads(pickled.read_bytes()))


def is_missed(mutant: Mutant, tests: list[str], seconds: dict[str, float]) -> bool:
    """Whether no test fails on the copy with the mutant; a test that exceeds its time limit counts as a failure."""
    own = mutant.path.read_text(encoding="utf-8")

    def run() -> int:
        signal.alarm(SLACK)
        return int(pytest.main(["-x", *PYTEST, *tests], plugins=[_TimeLimit(seconds)]))

    mutant.path.write_text(mutant.text, encoding="utf-8")
    try:
        return _in_a_child_process(run) == 0
    finally:
        mutant.path.write_text(own, encoding="utf-8")


def _in_a_child_process(task: Callable[[], int]) -> int:
    """The status of a task in a child process, which has torch loaded but imports the package from this folder."""
    child = os.fork()
    if child:
        _, status = os.waitpid(child, 0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what a test that was broken off had started
        return status
    status = 1
    try:
        os.setsid()
        sys.path.insert(0, str(Path.cwd()))
        del sys.modules["tests"]  # the copy has its own
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        output = os.open(OUTPUT, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        status = task()
    finally:
        os._exit(status)


def copy_and_enter(package: Path) -> None:
    """Copy what the tests need, compiled by content: a file changed twice in a second is compiled again."""
    for name in ("mkc_torch", "tests", "pyproject.toml"):
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, package / name)
    by_content = py_compile.PycInvalidationMode.CHECKED_HASH
    os.chdir(package)
    compileall.compile_dir(package, quiet=1, invalidation_mode=by_content)
    os.environ |= {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    sys.dont_write_bytecode = True
    for name in LOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def main() -> None:
    """Print each undetected mutant, and the share of detected mutants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", help="folder or file of mkc_torch")
    parser.add_argument("tests", nargs="+", help="paths of the tests that should detect a change")
    parser.add_argument("-n", type=int, default=0, help="number of mutants drawn; 0 tries all")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    left = 0
    with tempfile.TemporaryDirectory() as folder:
        copy_and_enter(Path(folder).resolve())
        room = Path("mkc_torch", options.room)
        files = sorted(room.rglob("*.py")) if room.is_dir() else [room]
        found = [place for file in files for place in mutation_sites(file)]
        if options.n:
            found = random.Random(options.seed).sample(found, min(options.n, len(found)))
        reached = reach_of(options.tests)
        for number, (path, node) in enumerate(found, start=1):
            mutant = mutant_of(path, node)
            tests = reached.tests_of(mutant)
            if is_missed(mutant, tests or options.tests, reached.seconds):
                left += 1
                print(f"survives {len(tests)} tests: {mutant.change}", flush=True)
            if number % 10 == 0:
                print(f"{number} of {len(found)} tried, {left} survive", flush=True)
        os.chdir(ROOT)
    print(f"{len(found) - left} of {len(found)} were detected, {100 * (1 - left / max(len(found), 1)):.0f} %")


if __name__ == "__main__":
    main()
