"""Which experiment distinguishes two effects, from the tangents of a recording in which they are collinear."""

import numpy as np
import pytest

from mkc_torch import diagnose
from mkc_torch.diagnosis.findings.advice import SAME, advice_of
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

pytestmark = pytest.mark.e2e

N = 2000
TIME = np.arange(N) / 50.0
CURRENT = 1.5 * np.sin(2.0 * np.pi * TIME / 9.0)
EFFECTS = [effect for effect in CATALOGUE if effect.id in ("current_field", "temperature_offset")]


def diagnosed(temperature, current=CURRENT):
    """Return the diagnosis of a current field whose temperature is correlated with the current, and the rival."""
    sensor = np.outer(current, [0.15, -0.12, 0.12])
    recording = tumbling(N, noise=0.4, sensor=sensor, current=current, temperature=20.0 + temperature)
    result = diagnose(Magnetometer("norm"), recording, effects=EFFECTS, surrogates=19, max_findings=1)
    (finding,) = result.findings
    return result, finding.alternatives[0]


def required_multiple(text):
    return float(text.split(" times as many samples")[0].split()[-1])


def test_the_distinguishing_state_is_reported():
    """The temperature follows the current except for its highest values, which are brief."""
    current = 1.5 * np.sin(2.0 * np.pi * TIME / 9.0) ** 3
    result, rival = diagnosed(np.minimum(current, 1.1), current)
    assert not rival.separable
    assert "in which temperature is above 20.3" in rival.distinguishing_state
    assert required_multiple(rival.distinguishing_state) > 1.0
    assert any(rival.distinguishing_state in sentence for sentence in advice_of(result))


def test_collinear_effects_cannot_be_distinguished_by_more_samples():
    result, rival = diagnosed(2.0 * CURRENT)
    assert (rival.separable, rival.distinguishing_state) == (False, SAME)
    assert any(SAME in sentence for sentence in result.advice)


def test_more_samples_are_needed_the_more_collinear_the_effects_are():
    far, near = (diagnosed(CURRENT + apart * np.sin(2.0 * np.pi * TIME / 4.3))[1] for apart in (0.25, 0.1))
    assert not far.separable
    assert not near.separable
    # the information that distinguishes them grows with the square of their difference
    assert required_multiple(near.distinguishing_state) / required_multiple(far.distinguishing_state) == pytest.approx(
        6.25, rel=0.35
    )


def test_separable_effects_need_no_further_recording():
    _, rival = diagnosed(CURRENT + 0.6 * np.sin(2.0 * np.pi * TIME / 4.3))
    assert (rival.separable, rival.distinguishing_state) == (True, "")
