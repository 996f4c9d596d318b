"""An offset that wanders must not take the name of physics that is beside it."""

import pytest

from mkc_torch import diagnose
from mkc_torch.challenge.magnetometer.generator import draw
from mkc_torch.simulation import Magnetometer

pytestmark = pytest.mark.e2e


def test_a_nonlinearity_beside_a_wandering_offset_is_named_alone():
    case = draw(7503, 42)
    assert case.key.effects[0].effect == "cubic_nonlinearity"
    result = diagnose(Magnetometer(), case.recording, surrogates=19)
    assert [finding.effect for finding in result.findings] == ["cubic_nonlinearity"]


def test_holes_in_a_wandering_field_are_no_gradient():
    case = draw(8111, 113, empty=True)
    assert not case.key.effects
    assert diagnose(Magnetometer(), case.recording, surrogates=19).findings == ()


def test_bursts_of_one_sign_do_not_hide_a_nonlinearity():
    case = draw(8111, 81)
    result = diagnose(Magnetometer(), case.recording, surrogates=19)
    assert [finding.effect for finding in result.findings] == [e.effect for e in case.key.effects]
