"""Held-out evidence of a finding that a later, larger finding masks."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence import prediction
from mkc_torch.diagnosis.evidence.base import EvidenceContext
from mkc_torch.diagnosis.evidence.held_out import blocks_of, held_out
from mkc_torch.diagnosis.model.fit import fitted, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term, find_drivers
from mkc_torch.diagnosis.settings import ConfirmationSettings, DriverSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

N = 1500
TIME = np.arange(N) / 50.0
SMALL = np.sin(2.0 * np.pi * TIME / 3.7)
LARGE = np.sin(2.0 * np.pi * TIME / 11.3)
OFFSET = next(effect for effect in CATALOGUE if effect.id == "driver_offset")


@pytest.fixture(scope="module")
def fits():
    """Return three fits: without an effect, with the small effect, and with both effects."""
    sensor = np.outer(SMALL, [0.4, -0.3, 0.4]) + np.outer(LARGE, [4.0, 3.0, -5.0])
    recording = tumbling(N, noise=0.3, sensor=sensor, small=SMALL, large=LARGE)
    simulation = Magnetometer("norm")
    prepared = simulation.prepare(recording)
    known = {
        driver.columns[0]: driver
        for driver in find_drivers(prepared.recording, simulation.columns, DriverSettings()).drivers
    }
    done = [fitted(JointModel(prepared), prepared.start())]
    for name in ("small", "large"):
        model = done[-1].model.with_term(Term(OFFSET, known[name], OFFSET.shapes(prepared.time)[0]))
        start = torch.cat([done[-1].parameters, done[-1].parameters.new_zeros(model.size - done[-1].model.size)])
        done.append(fitted_with_effect(done[0], model, start))
    return done


@pytest.fixture
def evidence_without_small(fits):
    """Return a function for the evidence without the small effect, and the held-out evidence of each fit."""
    blocks = blocks_of(N, 1, ConfirmationSettings())
    none, small, both = fits
    found = SimpleNamespace(fit=small), SimpleNamespace(fit=both)

    def without(*evidence):
        return prediction.without_finding(EvidenceContext(none, None, found, evidence, blocks, (), 0, Settings()))

    return without, [held_out(fit, blocks) for fit in fits]


@pytest.mark.e2e
def test_an_effect_not_confirmed_alone_is_evaluated_given_the_other(fits, evidence_without_small):
    without_small, (none, _, both) = evidence_without_small
    without = without_small(none, none, both)
    blocks = blocks_of(N, 1, ConfirmationSettings())
    alone = fitted_with_effect(
        fits[0], fits[0].model.with_term(fits[2].model.terms[1]), torch.cat([fits[0].parameters, torch.zeros(3)])
    )
    torch.testing.assert_close(without.residual, held_out(alone, blocks).residual, atol=0.02, rtol=0.0)
    assert float((both.log_likelihood - without.log_likelihood).mean()) > 0.1


def test_an_effect_confirmed_alone_is_not_evaluated_again(evidence_without_small):
    without_small, (none, _, both) = evidence_without_small
    assert without_small(none, both, both) is None


@pytest.mark.e2e
def test_a_diagnosis_notes_that_a_finding_was_evaluated_given_the_others(monkeypatch):
    monkeypatch.setattr(prediction, "confirmed_alone", lambda *_: False)
    current = np.sign(np.sin(2.0 * np.pi * TIME / 3.7))
    sensor = np.outer(current, [0.6, -0.5, 0.6]) + np.outer(TIME >= 14.0, [3.0, 2.0, -3.0])
    effects = [effect for effect in CATALOGUE if effect.id in ("current_field", "hard_iron_step")]
    recording = tumbling(N, noise=0.3, sensor=sensor, current=current)
    first, last = diagnose(Magnetometer("norm"), recording, effects=effects, surrogates=19, max_findings=2).findings
    assert first.held_out_note.startswith("Scored given the other findings")
    assert first.held_out.rmse_after == last.held_out.rmse_after < first.held_out.rmse_before
    assert last.held_out_note == ""
