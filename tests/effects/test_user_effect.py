"""A user's own effect is found and named together with the catalogue."""

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import CATALOGUE, GainEffect
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

GAIN = (1.0, -0.6, 0.4)


class SupplyOffset(GainEffect):
    """The sensor's offset follows the supply voltage."""

    id = "supply_offset"
    roles = ("voltage",)
    gain = "offset_per_volt"
    equation = "δB = k (V − V̄)"
    explanation = "The offset follows the supply voltage."
    plausible = 2.0
    source = "our bench"

    def waveform(self, shape, context):
        return context.drivers[:, 0]


@pytest.fixture(scope="module")
def diagnosis():
    time = np.arange(600) / 50.0
    voltage = 12.0 + np.sin(2.0 * time) + 0.5 * np.sin(5.3 * time)
    sensor = np.outer(voltage - voltage.mean(), GAIN)
    recording = tumbling(600, noise=0.3, sensor=sensor, voltage=voltage)
    return diagnose(Magnetometer(), recording, effects=(*CATALOGUE, SupplyOffset()), surrogates=19, max_findings=1)


@pytest.mark.e2e
def test_a_user_effect_is_found_by_the_role_of_its_column(diagnosis):
    assert [(f.effect, f.drivers) for f in diagnosis.findings] == [("supply_offset", ("voltage",))]


def test_the_unknown_curve_is_tried_on_the_column_of_a_user_effect():
    """With a wrong formula of the user, the mismatch must not count as adequate."""
    prepared = Magnetometer().prepare(tumbling(600, noise=0.3, voltage=np.sin(np.arange(600) / 25.0)))
    effects = (*CATALOGUE, SupplyOffset())
    drivers = find_drivers(prepared.recording, Magnetometer().columns, DriverSettings(), frozenset({"voltage", "any"}))
    tried = {term.key for term in candidate_terms(prepared, drivers.drivers, effects)}
    tried = {key[:2] for key in tried}
    assert ("supply_offset", ("voltage",)) in tried
    assert ("driver_offset", ("voltage",)) not in tried
    assert ("unknown", ("voltage",)) in tried


@pytest.mark.e2e
def test_the_finding_has_the_texts_of_the_effect(diagnosis):
    (finding,) = diagnosis.findings
    assert finding.equation == SupplyOffset.equation
    assert finding.explanation.startswith(SupplyOffset.explanation)
    assert finding.plausible
    assert "our bench" in finding.plausibility
    gain = finding.parameters[0]
    assert (gain.name, gain.unit) == ("offset_per_volt", "µT")
    value, error = np.array(gain.value), np.array(gain.standard_error)
    assert (np.abs(value - GAIN) < 4.0 * error).all()
    assert (error < 0.1).all()


@pytest.mark.e2e
def test_the_model_removes_the_effect(diagnosis):
    time = np.arange(300) / 50.0
    voltage = 12.0 + np.cos(3.0 * time)
    clean, contaminated = (
        tumbling(300, voltage=voltage),
        tumbling(300, sensor=np.outer(voltage - 12.0, GAIN), voltage=voltage),
    )
    model = DiagnosedModel.from_json(diagnosis.model.to_json(), effects=(*CATALOGUE, SupplyOffset()))
    strengths = []
    for recording in (clean, contaminated):
        columns, _ = model.correct(recording)
        strengths.append(torch.stack([columns[f"field_{axis}"] for axis in "xyz"], -1).norm(dim=-1))
    assert float(strengths[1].std()) < 0.1
    assert float(strengths[0].std()) > 0.3
