"""A sensor's clock of another rate, and an input that acts a row late, on a driven mass."""

import pytest

from mkc_torch import diagnose
from mkc_torch.diagnosis.findings.one_row import rows_late
from mkc_torch.diagnosis.parts import EffectParameter
from tests.diagnosis.clocks import STEP, Stage, stage_recording


@pytest.mark.e2e
@pytest.mark.parametrize("rate", [0.006, pytest.param(-0.006, marks=pytest.mark.slow)])
def test_a_clock_of_another_rate_is_found_with_its_rate(rate):
    found = diagnose(Stage(), stage_recording(1, rate=rate), surrogates=19, max_findings=1)
    [finding] = found.findings
    assert finding.effect == "sensor_clock_drift"
    [parameter] = finding.parameters
    assert parameter.unit == "%"
    assert abs(parameter.value - 100.0 * rate) < 3.0 * parameter.standard_error < 0.02
    size = f"{abs(parameter.value):.3g} % {'fast' if rate > 0 else 'slow'}"
    assert finding.explanation == f"The clock of output `position` runs {size} relative to the clock of the inputs."


@pytest.mark.e2e
@pytest.mark.slow
def test_a_constant_offset_of_the_clocks_is_no_drift():
    """The force acts three samples before its column shows it, which no effect of the catalogue names."""
    found = diagnose(Stage(), stage_recording(1, late=-3), surrogates=19, max_findings=1)
    assert found.p_value <= 0.05
    assert "sensor_clock_drift" not in {finding.effect for finding in found.findings}


@pytest.mark.e2e
def test_an_input_that_acts_a_row_late_is_named_as_that():
    found = diagnose(Stage(), stage_recording(1, late=1), surrogates=19, max_findings=1)
    assert [finding.effect for finding in found.findings] == ["input_delay"]
    assert "acts one row late" in found.findings[0].explanation
    assert "Shift the column `force` by one row" in found.findings[0].advice


@pytest.mark.parametrize(
    ("delay", "error", "share", "rows"),
    [
        (STEP, 0.004, 1.0, 1),
        (-STEP, 0.004, 1.0, -1),
        (0.9 * STEP, 0.004, 0.95, 1),
        (2.0 * STEP, 0.004, 1.0, 0),
        (STEP, 0.004, 0.3, 0),
        (STEP, STEP, 1.0, 0),
        (STEP, None, 1.0, 0),
    ],
)
def test_a_delay_is_one_row_within_its_error_only(delay, error, share, rows):
    parameters = [EffectParameter("share", share, 0.1, ""), EffectParameter("delay", delay, error, "s")]
    assert rows_late(parameters, STEP) == rows
