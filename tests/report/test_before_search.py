"""The checks before the search and the untested candidates, in terminal, report and diagnosis.json."""

from __future__ import annotations

import dataclasses
import io
import json

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("jsonschema")

from rich.console import Console

from mkc_torch import Recording, diagnose
from mkc_torch.cli.diagnosis_summary import show
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.report.diagnosis.page import diagnosis_report
from mkc_torch.simulation import Static
from mkc_torch.simulation.start_checks import StartCheck
from tests.diagnosis.factory import make_diagnosis
from tests.report.test_calibration_report import text_of

CHECKS = (
    StartCheck("no equation", ("bias",), "`bias` is in no equation."),
    StartCheck("only together", ("gain", "mass"), "Only `gain / mass` is determined.", "gain / mass", 0.998),
    StartCheck("at a bound", ("drag",), "`drag` starts at its bound 0.", start=0.01),
)


def terminal(diagnosis) -> str:
    stream = io.StringIO()
    show(Console(file=stream, width=200, highlight=False), diagnosis, [])
    return stream.getvalue()


def test_the_checks_stand_before_the_findings_in_terminal_and_report():
    diagnosis = dataclasses.replace(make_diagnosis(1), checks=CHECKS)
    shown = {"offset change": terminal(diagnosis), "driven by": text_of(diagnosis_report(diagnosis))}
    for after, text in shown.items():
        assert "Before the search" in text
        places = [text.index(words) for words in ("in no equation", "gain / mass", "starts at its bound 0")]
        assert places == sorted(places)
        assert places[-1] < text.index(after)
    assert "Before the search" not in terminal(make_diagnosis(1))
    assert "Before the search" not in text_of(diagnosis_report(make_diagnosis(1)))


def test_the_checks_are_in_the_file():
    written = json.loads(diagnosis_to_json(dataclasses.replace(make_diagnosis(1), checks=CHECKS)))["before_the_search"]
    assert [check["kind"] for check in written] == ["no equation", "only together", "at a bound"]
    assert written[1] == {
        "kind": "only together",
        "parameters": ["gain", "mass"],
        "sentence": "Only `gain / mass` is determined.",
        "combination": "gain / mass",
        "correlation": 0.998,
    }
    assert written[2]["start"] == 0.01


class Thermistor(Static):
    inputs, outputs, parameters = ("temperature",), ("voltage",), {"slope": 0.01, "offset": 0.0}

    def output(self, time, u, p):
        return {"voltage": p.offset + p.slope * u.temperature}


def bench(samples: int) -> Recording:
    time = torch.arange(samples, dtype=torch.float64)
    temperature = 20.0 + 10.0 * torch.sin(time / 3.0)
    noise = 0.005 * torch.randn(samples, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    voltage = 0.3 + 0.02 * temperature + 0.001 * temperature**2 + noise
    return Recording({"time": time, "temperature": temperature, "voltage": voltage})


@pytest.mark.e2e
@pytest.mark.parametrize("samples", [8, 25, 39])
def test_few_samples_give_a_fit_and_candidates_without_p_values(samples):
    diagnosis = diagnose(Thermistor(), bench(samples), surrogates=19)
    assert (diagnosis.too_few, diagnosis.p_value, diagnosis.findings) == (True, None, ())
    assert diagnosis.verdict in ("unexplained", "unfit")
    assert f"{samples} samples are too few" in diagnosis.advice[0] or diagnosis.verdict == "unfit"
    text, page = terminal(diagnosis), text_of(diagnosis_report(diagnosis))
    assert text.count(", not tested") == 3
    assert "Strongest candidates, not tested" in page
    assert "fit           voltage: residual" in text
    assert json.loads(diagnosis_to_json(diagnosis))["search"]["surrogates"] == 0


def test_fewer_samples_than_a_fit_needs_raise():
    with pytest.raises(ValueError, match="7 usable samples are too few for a fit of 2 parameters and initial states"):
        diagnose(Thermistor(), bench(7))


@pytest.mark.e2e
def test_enough_samples_are_tested():
    diagnosis = diagnose(Thermistor(), bench(40), surrogates=19)
    assert not diagnosis.too_few
    assert diagnosis.p_value is not None
