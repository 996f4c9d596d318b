"""Every test in the table of promises exists, and is named once."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NAMED = re.compile(r"\| `(tests/[\w/]+\.py)::(test_\w+)` \|$")


def rows():
    lines = (ROOT / "docs" / "promises.md").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.startswith("|") and not line.startswith(("|---", "| promise"))]


def test_every_promise_names_an_existing_test():
    assert len(rows()) >= 50
    absent = []
    for row in rows():
        named = NAMED.search(row)
        assert named is not None, row
        tree = ast.parse((ROOT / named[1]).read_text(encoding="utf-8"))
        if named[2] not in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}:
            absent.append(named[0])
    assert absent == []


def test_no_test_belongs_to_two_promises():
    tests = [NAMED.search(row)[0] for row in rows()]
    assert len(set(tests)) == len(tests)
