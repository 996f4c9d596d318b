"""Public names, signatures and types change only together with their snapshot."""

import pytest

pytest.importorskip("griffe")

from tests.public_api import SNAPSHOT, public_api


def test_the_public_api_equals_its_snapshot():
    assert public_api().splitlines() == SNAPSHOT.read_text(encoding="utf-8").splitlines(), (
        "The public API has changed. If that is meant, run `python -m tests.public_api` and commit the snapshot."
    )
