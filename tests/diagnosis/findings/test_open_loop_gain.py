"""Whether an effect is needed for the simulation to follow the recording in open loop."""

import pytest

from mkc_torch.diagnosis.findings.shape import improves_open_loop
from tests.diagnosis.cart import DRAG, first_term, fit_with, free_fit


def test_an_effect_that_halves_the_open_loop_residual_is_needed():
    alone = free_fit(DRAG)
    drag, none = (fit_with(alone, first_term(alone, name)) for name in ("quadratic_drag", "input_saturation"))
    assert float(drag.residual.std()) < 0.3 * float(alone.residual.std())
    assert float(none.residual.std()) == pytest.approx(float(alone.residual.std()), rel=0.05)
    assert improves_open_loop(drag, alone)
    assert not improves_open_loop(none, alone)
