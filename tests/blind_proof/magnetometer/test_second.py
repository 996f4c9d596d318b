import dataclasses

import pytest
import torch

from examples.blind_proof.magnetometer.cases import draw
from examples.blind_proof.magnetometer.power import ratio_to_oracle


@pytest.fixture(scope="module")
def cases():
    return [draw(20.0, 11, k) for k in range(8)]


def corrected_field(case):
    """Return the second recording corrected by the true calibration, without the effect."""
    inverse = torch.linalg.inv(torch.tensor(case.key.sensor["soft"]).double())
    field = (case.second.magnetometer() - torch.tensor(case.key.sensor["hard"]).double()) @ inverse.mT
    return {f"field_{axis}": column for axis, column in zip("xyz", field.unbind(-1), strict=True)}


def test_a_correction_without_the_effect_is_not_better_than_the_oracle(cases):
    white = [case for case in cases if case.key.noise["kind"] == "white"]
    assert white
    for case in white:
        assert ratio_to_oracle(corrected_field(case), case.key) > 0.95


def test_the_true_calibration_equals_the_oracle_without_an_effect(cases):
    case = cases[0]
    key = dataclasses.replace(case.key, oracle_rms=0.5, second_outliers=(0,), field_strength=50.0)
    length = 50.0 + 0.5 * torch.randn(5000, generator=torch.Generator().manual_seed(0)).double()
    length[0] = 500.0
    zero = torch.zeros_like(length)
    scaled = {"field_x": 0.02 * length, "field_y": zero, "field_z": zero}
    assert ratio_to_oracle(scaled, key) == pytest.approx(1.0, abs=0.03)


def test_a_field_of_nan_has_an_infinite_ratio_to_the_oracle(cases):
    bad = {name: torch.full_like(values, torch.nan) for name, values in corrected_field(cases[0]).items()}
    assert ratio_to_oracle(bad, cases[0].key) == float("inf")


def test_the_oracle_residual_is_near_the_size_of_white_noise(cases):
    keys = [case.key for case in cases if case.key.noise["kind"] == "white"]
    ratios = torch.tensor([key.oracle_rms / key.noise["sigma"] for key in keys])
    assert float(ratios.min()) > 0.8
    assert float(ratios.median()) < 1.3
