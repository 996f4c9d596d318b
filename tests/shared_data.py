"""Real recordings, published tables and kept cases, in a folder next to the project, and not part of it."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "shared" / "data"
CASES = ROOT.parent / "cases"
REAL = ROOT.parent / "real"


def shared_data(path: str) -> Path:
    """The file or folder ``path`` of the shared data; where it is absent the test is skipped, naming it."""
    return _there(ROOT / path)


def shared_case(path: str) -> Path:
    """The same of the cases, each a recording with a simulation of it, whose right answer is known."""
    return _there(CASES / path)


def shared_real(path: str) -> Path:
    """The same of the real recordings whose missing physics is known."""
    return _there(REAL / path)


def _there(found: Path) -> Path:
    if not found.exists():
        pytest.skip(f"no data file {found}")
    return found
