"""Warnings and plausibility of a whole diagnosis."""

import numpy as np
import pytest

from mkc_torch import Recording, diagnose
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

pytestmark = pytest.mark.e2e


def in_units(recording, **units):
    return Recording(recording.columns, name=recording.name, units={**recording.units, **units})


def test_structure_beyond_max_findings_is_warned_of():
    N = 2000
    time = np.arange(N) / 50.0
    current = np.sin(2.0 * np.pi * time / 3.3)
    temperature = 20.0 + 4.0 * np.sin(2.0 * np.pi * time / 17.0)
    sensor = np.outer(current, [3.0, -2.0, 2.0]) + np.outer(temperature, [0.8, 0.5, -0.6])
    recording = tumbling(N, noise=0.3, sensor=sensor, current=current, temperature=temperature)
    limited = diagnose(Magnetometer(), recording, surrogates=19, max_findings=1)
    assert (len(limited.findings), limited.verdict) == (1, "unexplained")
    assert any("`max_findings`" in warning for warning in limited.warnings)
    two = diagnose(Magnetometer(), recording, surrogates=19, max_findings=2)
    assert ({f.effect for f in two.findings}, two.verdict) == ({"current_field", "temperature_offset"}, "explained")


def test_sizes_are_compared_in_the_unit_of_the_driver():
    current = np.sin(2.0 * np.arange(1500) / 50.0)
    sensor = np.outer(current, [3.0, -2.0, 2.0])
    effects = [effect for effect in CATALOGUE if effect.id == "current_field"]
    for scale, unit, known in ((1.0, "A", "20 µT/A"), (1000.0, "mA", "0.02 µT/mA")):
        recording = in_units(tumbling(1500, noise=0.3, sensor=sensor, current=scale * current), current=unit)
        (finding,) = diagnose(Magnetometer(), recording, effects=effects, surrogates=19).findings
        assert finding.plausible
        assert known in finding.plausibility


def test_sizes_in_unknown_units_are_not_judged():
    current = np.sin(2.0 * np.arange(1500) / 50.0)
    recording = tumbling(1500, noise=0.3, sensor=np.outer(current, [3.0, -2.0, 2.0]), current=current)
    recording = in_units(recording, mag_x="counts", mag_y="counts", mag_z="counts")
    effects = [effect for effect in CATALOGUE if effect.id == "current_field"]
    (finding,) = diagnose(Magnetometer(), recording, effects=effects, surrogates=19).findings
    assert finding.plausible
    assert "known only in µT/A" in finding.plausibility
