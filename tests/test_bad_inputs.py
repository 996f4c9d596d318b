"""Every bad input gets a message of whole sentences, without a traceback, a NaN or a changed file."""

import re

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("pandas")

from tests.bad_inputs import HEAD, PAGE, bad_inputs, cell, rows


@pytest.fixture(scope="module")
def inputs_and_messages():
    for reader in ("fmpy", "pyulog", "pymavlink", "mcap", "rosbags", "scipy", "h5py", "asammdf"):
        pytest.importorskip(reader)
    return list(rows())


def test_the_page_lists_every_input_under_its_heading():
    """The messages themselves are built by `python -m tests.bad_inputs`, and checked below."""
    listed, group = [], ""
    for line in PAGE.read_text(encoding="utf-8").removeprefix(HEAD).splitlines():
        if line.startswith("## "):
            group = line.removeprefix("## ")
        elif line.startswith("| ") and not line.startswith("| input |"):
            listed.append((group, re.split(r"(?<!\\) \| ", line)[0].removeprefix("| ")))
    assert listed == [(bad.group, cell(bad.given)) for bad in bad_inputs()]


def test_bad_inputs_are_many_and_differ():
    given = [(bad.group, bad.given) for bad in bad_inputs()]
    assert len(set(given)) == len(given) >= 80


@pytest.mark.manual
def test_each_message_is_a_sentence(inputs_and_messages):
    for bad, message in inputs_and_messages:
        assert re.search(r"[.:][)\"`]*$|\.$", message), (bad.given, message)
        assert len(message) > 20, (bad.given, message)
        assert "Traceback" not in message
        assert not re.search(r"(?<!write )(?<!got )(?<!is )\bnan\b|\bNaN\b(?!: lower)", message), (bad.given, message)
        assert not re.search(r"/tmp|\.py\"?, line|0x7f", message), message


@pytest.mark.manual
def test_most_messages_differ(inputs_and_messages):
    assert len({message for _, message in inputs_and_messages}) > 0.8 * len(inputs_and_messages)
