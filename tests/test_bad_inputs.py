"""The page of bad inputs is what is said of each: a sentence, no traceback, no NaN, and no file lost."""

import re

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("pandas")

from tests.bad_inputs import HEAD, PAGE, bad_inputs, page, row, rows


@pytest.fixture(scope="module")
def found():
    for reader in ("fmpy", "pyulog", "pymavlink", "mcap", "rosbags", "scipy", "h5py", "asammdf"):
        pytest.importorskip(reader)
    return list(rows())


@pytest.mark.manual
def test_the_page_says_of_each_what_is_said(found):
    text = PAGE.read_text(encoding="utf-8")
    assert text.startswith(HEAD)
    told = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| what was given")]
    assert told == [row(bad, said) for bad, said in found]


@pytest.mark.manual
def test_the_page_has_each_under_its_heading(found, monkeypatch):
    monkeypatch.setattr("tests.bad_inputs.rows", lambda: iter(found))
    assert page() == PAGE.read_text(encoding="utf-8")


def test_they_are_many_and_differ():
    given = [(bad.group, bad.given) for bad in bad_inputs()]
    assert len(set(given)) == len(given) >= 80


@pytest.mark.manual
def test_each_is_told_in_sentences(found):
    for bad, said in found:
        assert re.search(r"[.:][)\"`]*$|\.$", said), (bad.given, said)
        assert len(said) > 20, (bad.given, said)
        assert "Traceback" not in said
        assert not re.search(r"(?<!write )(?<!got )(?<!is )\bnan\b|\bNaN\b(?!: lower)", said), (bad.given, said)
        assert not re.search(r"/tmp|\.py\"?, line|0x7f", said), said


@pytest.mark.manual
def test_most_are_said_differently(found):
    assert len({said for _, said in found}) > 0.8 * len(found)
