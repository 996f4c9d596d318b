"""Real recordings, published tables and stored cases, in a folder next to the project."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "shared" / "data"
CASES = ROOT.parent / "cases"
REAL = ROOT.parent / "real"


def shared_data(path: str) -> Path:
    """The file or folder ``path`` of the shared data; where it is absent the test is skipped, naming it."""
    return _there(ROOT / path)


def shared_case(path: str) -> Path:
    """Like `shared_data`, for cases: recordings with a simulation whose missing physics is known."""
    return _there(CASES / path)


def shared_real(path: str) -> Path:
    """Like `shared_data`, for real recordings whose missing physics is known."""
    return _there(REAL / path)


def _there(found: Path) -> Path:
    if not found.exists():
        pytest.skip(f"no data file {found}")
    return found
