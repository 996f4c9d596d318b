import io
import re
from collections import Counter
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("rich")

from rich.console import Console

import mkc_torch
from mkc_torch._words.terms import TERMS, term
from mkc_torch.cli import diagnosis_summary
from mkc_torch.report.diagnosis.page import diagnosis_report
from tests.diagnosis.factory import make_diagnosis

PACKAGE = Path(mkc_torch.__file__).parent
TABLE = PACKAGE / "_words" / "terms.py"
REFERENCE = re.compile(r"\[([a-z]+\.[a-z_]+)\]")
KEY = re.compile(r"""["']([a-z]+\.[a-z_]+)["']""")
FILES = {"calibration.json", "calibration.page"}  # names of a file and of a module that look like keys
GROUPS = {key.partition(".")[0] for key in TERMS}


def sources():
    folders = [PACKAGE / room for room in ("_words", "calibration", "diagnosis", "report", "cli")]
    return [p for folder in folders for p in folder.rglob("*") if p.suffix in (".py", ".j2") and p != TABLE]


def used():
    """Keys that the source and the templates name, and those that other terms name."""
    found = {key for path in sources() for key in KEY.findall(path.read_text(encoding="utf-8"))}
    return found | {key for text in TERMS.values() for key in REFERENCE.findall(text)}


def terminal(diagnosis):
    stream = io.StringIO()
    diagnosis_summary.show(Console(file=stream, width=200, highlight=False), diagnosis, [])
    return stream.getvalue()


def test_every_term_is_shown_somewhere():
    assert set(TERMS) - used() == set()


def test_every_term_that_is_named_is_in_the_table():
    named = {key for key in used() if key.partition(".")[0] in GROUPS} - FILES
    assert named - set(TERMS) == set()


def test_one_meaning_has_one_term():
    counted = Counter(text.casefold().rstrip(".") for text in TERMS.values())
    assert [text for text, count in counted.items() if count > 1] == []


def test_a_term_that_is_not_there_and_a_place_without_a_value_are_errors():
    with pytest.raises(KeyError, match=r"verdict\.unheard_of"):
        term("verdict.unheard_of")
    for values in ({}, {"start": "1.0"}):
        with pytest.raises(KeyError, match=r"start|end"):
            term("where.interval", **values)


def test_values_are_put_in_as_they_are():
    assert term("label.against", recording="[unit.nats] {x}", simulation="b") == "[unit.nats] {x} against b"


@pytest.mark.parametrize(
    ("key", "changed", "seen"),
    [
        ("unit.nats", "units of e", "units of e per sample"),
        ("unit.unseen", "withheld", "surely better on withheld blocks"),
        ("evidence.surely", "certainly better", "certainly better"),
        ("verdict.left_out", "Missing: {findings}.", "Missing: hard-iron step"),
        ("label.driven_by", "in step with", "in step with"),
        ("noise.autoregressive", "with a memory", "ith a memory: noise"),
    ],
)
def test_changing_one_term_changes_terminal_and_report(monkeypatch, key, changed, seen):
    diagnosis = make_diagnosis(1, samples=200)
    was = [terminal(diagnosis), diagnosis_report(diagnosis)]
    assert not any(seen in text for text in was)
    monkeypatch.setitem(TERMS, key, changed)
    sentences = [terminal(diagnosis), diagnosis_report(diagnosis)]
    assert all(seen in text for text in sentences)


def test_nothing_of_a_changed_term_is_left(monkeypatch):
    diagnosis = make_diagnosis(2, samples=200)
    monkeypatch.setitem(TERMS, "unit.nats", "units")
    assert not re.search(r"\bnats\b", terminal(diagnosis) + diagnosis_report(diagnosis))
