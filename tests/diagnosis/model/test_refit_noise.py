"""The refit of a model under its remaining noise."""

import math

from mkc_torch.diagnosis.model import process_noise
from mkc_torch.diagnosis.model.process_noise import estimate_noise, noise_of_fit, refit_noise
from mkc_torch.diagnosis.settings import NoiseSettings
from tests.diagnosis.swing import fitted_pendulum


def test_the_noise_of_the_open_loop_is_estimated_only_above_a_minimum_likelihood(monkeypatch):
    fit, estimates = fitted_pendulum("white").fit, []
    monkeypatch.setattr(process_noise, "estimate_noise", lambda *a: estimates.append(a) or estimate_noise(*a))
    counts = []
    for least in (-math.inf, math.inf):
        estimates.clear()
        refit_noise(fit, noise_of_fit(fit, {}), {}, NoiseSettings(), least)
        counts.append(len(estimates))
    assert counts[1] == counts[0] - 1
