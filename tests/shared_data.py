"""Real recordings and published tables, which lie beside the project and are not part of it."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "shared" / "data"


def shared_data(path: str) -> Path:
    """The file or folder ``path`` of the shared data; where it is absent the test is skipped, naming it."""
    found = ROOT / path
    if not found.exists():
        pytest.skip(f"no data file {found}")
    return found
