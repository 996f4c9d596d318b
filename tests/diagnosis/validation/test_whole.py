"""A diagnosis of stretches states its residuals in the whole recording."""

from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.validation.whole import with_whole_recording
from mkc_torch.simulation import Static
from tests.diagnosis.validation.tank import tank_recording, usual_model


@pytest.fixture(scope="module")
def result():
    heat = torch.sin(torch.arange(100) / 10.0)
    recording = Recording({"time": torch.arange(100) / 10.0, "heat": heat, "voltage": 2.0 * heat + 0.01 * heat.cos()})
    line = Static(torch.nn.Linear(1, 1), inputs=("heat",), outputs=("voltage",))
    return diagnose(line, recording, effects=(), surrogates=19)


def test_the_note_has_the_residuals_with_and_without_findings(result):
    found = with_whole_recording(replace(result, model=usual_model()), tank_recording(1))
    (note,) = found.notes[len(result.notes) :]
    assert note.startswith("Residuals in ")
    assert "`level` 0.00" in note
    assert note.index("with the findings") < note.index("without")
    assert found.warnings == result.warnings


def test_findings_that_do_not_hold_in_the_whole_recording_are_warned_of(result):
    found = with_whole_recording(replace(result, model=usual_model()), tank_recording(1, drag=0.0))
    (warning,) = found.warnings[len(result.warnings) :]
    assert warning.startswith("All samples: level: the findings do not make the residual clearly smaller")


def test_a_diagnosis_of_all_samples_and_one_without_a_model_are_as_they_were(result):
    assert with_whole_recording(result, None) is result
    without = replace(result, model=None)
    assert with_whole_recording(without, tank_recording(1)) is without
