"""A finding beyond the limit takes the place of one that stood for a part of it."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.effects import PAIRED, played, shifted
from mkc_torch.simulation import Paired

EFFECTS = [effect for effect in PAIRED if effect.id in ("backlash", "delay", "offset", "output_saturation")]


@pytest.mark.e2e
def test_play_takes_the_place_of_a_limit_that_was_found_before_the_offset():
    time = torch.arange(700, dtype=torch.float64) / 25.0
    command = 0.35 * torch.sin(2.0 * torch.pi * (0.15 * time + 0.0152 * time**2))
    noise = 0.001 * torch.randn(700, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    joint = played(shifted(command, time, -0.1), time, 0.02) + 0.02 + noise
    arm = Paired(Recording({"time": time, "joint": command}))
    found = diagnose(arm, Recording({"time": time, "joint": joint}), effects=EFFECTS, surrogates=19)
    sizes = {finding.effect: finding.parameters[0].value for finding in found.findings}
    assert sizes == pytest.approx({"delay": 0.1, "offset": 0.02, "backlash": 0.02}, rel=0.03)
