"""A drifting offset must not hide or imitate physics."""

import pytest

from examples.blind_proof.magnetometer.cases import draw
from examples.blind_proof.magnetometer.motion import DURATION
from mkc_torch import diagnose
from mkc_torch.simulation import Magnetometer

pytestmark = pytest.mark.e2e


def test_a_nonlinearity_with_a_drifting_offset_is_the_only_finding():
    case = draw(DURATION, 7503, 42)
    assert case.key.effects[0].effect == "cubic_nonlinearity"
    result = diagnose(Magnetometer(), case.recording, surrogates=19)
    assert [finding.effect for finding in result.findings] == ["cubic_nonlinearity"]


def test_rejected_samples_in_a_drifting_field_are_no_gradient():
    case = draw(DURATION, 8111, 113, hidden=False)
    assert not case.key.effects
    assert diagnose(Magnetometer(), case.recording, surrogates=19).findings == ()


def test_bursts_of_one_sign_do_not_hide_a_nonlinearity():
    case = draw(DURATION, 8111, 81)
    result = diagnose(Magnetometer(), case.recording, surrogates=19)
    assert [finding.effect for finding in result.findings] == [e.effect for e in case.key.effects]
