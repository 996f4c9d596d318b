import dataclasses
import math

import numpy as np
import pytest
import torch

from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.calibration.differences import LEVEL, differences
from mkc_torch.report.words.comparison import difference_rows, difference_sentences
from tests.calibration.test_calibrate import noisy_ellipsoid, recorded


@pytest.fixture(scope="module")
def points():
    return noisy_ellipsoid(300, seed=1)


@pytest.fixture(scope="module")
def two_calibrations(points):
    return calibrate(recorded(points), name="new"), calibrate(recorded(noisy_ellipsoid(300, seed=2)), name="old")


def test_calibrations_of_a_sensor_agree_within_errors(two_calibrations, points):
    found = differences(*two_calibrations, points)
    assert len(found.numbers) == 10
    assert found.beyond == ()
    assert "offset" in difference_sentences(found)[0] or "matrix" in difference_sentences(found)[0]
    assert f"{found.limit:.3g}" in difference_sentences(found)[0]
    assert found.name == "old"


def test_a_calibration_does_not_differ_from_itself(two_calibrations, points):
    found = differences(two_calibrations[0], two_calibrations[0], points)
    assert {difference.in_errors for difference in found.numbers} == {0.0}
    assert (found.angle_max, found.length_max) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert difference_sentences(found)[1].count("0° and 0 µT") == 2


def test_errors_are_combined_and_the_limit_is_that_of_bonferroni(two_calibrations, points):
    new, old = two_calibrations
    found = differences(new, old, points)
    offset_x, matrix_yz = found.numbers[0], found.numbers[-2]
    assert offset_x.error == pytest.approx(math.sqrt(new.center_se[0] ** 2 + old.center_se[0] ** 2))
    assert offset_x.in_errors == pytest.approx((new.center[0] - old.center[0]) / offset_x.error)
    assert (matrix_yz.name, matrix_yz.new, matrix_yz.old) == ("matrix yz", new.matrix[1][2], old.matrix[1][2])
    tail = torch.special.erfc(torch.tensor(found.limit / math.sqrt(2.0), dtype=torch.float64))
    assert float(tail) * 10 == pytest.approx(LEVEL)


def test_a_changed_offset_and_its_effect_on_the_field_are_reported(two_calibrations, points):
    """0.8 µT across the field turns it by 0.8/48 rad at most, and 0.8 µT along makes it so much longer."""
    new, _ = two_calibrations
    old = dataclasses.replace(new, center=(new.center[0] + 0.8, *new.center[1:]), name="before")
    found = differences(new, old, points)
    assert [difference.name for difference in found.beyond] == ["offset x"]
    assert found.beyond[0].in_errors == pytest.approx(-0.8 / (math.sqrt(2) * new.center_se[0]))
    ours, theirs = new.corrected(points).numpy(), old.corrected(points).numpy()
    lengths = np.linalg.norm(ours, axis=1) - np.linalg.norm(theirs, axis=1)
    cosines = (ours * theirs).sum(1) / np.linalg.norm(ours, axis=1) / np.linalg.norm(theirs, axis=1)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    assert found.length_max == pytest.approx(np.abs(lengths).max())
    assert found.length_rms == pytest.approx(np.sqrt((lengths**2).mean()))
    assert found.angle_max == pytest.approx(angles.max(), rel=1e-6)
    assert found.angle_rms == pytest.approx(np.sqrt((angles**2).mean()), rel=1e-6)
    sentences = difference_sentences(found)
    assert "offset x by −" in sentences[0]
    assert f"{len(points)} samples" in sentences[1]


def test_an_older_calibration_in_other_units_is_converted(two_calibrations, points):
    new, old = two_calibrations
    in_gauss = dataclasses.replace(
        old,
        unit="gauss",
        field_unit="gauss",
        center=tuple(0.01 * v for v in old.center),
        center_se=tuple(0.01 * v for v in old.center_se),
        semi_axes=tuple(0.01 * v for v in old.semi_axes),
        semi_axes_se=tuple(0.01 * v for v in old.semi_axes_se),
        radius=0.01 * old.radius,
    )
    expected, found = differences(new, old, points), differences(new, in_gauss, points)
    for difference, other in zip(found.numbers, expected.numbers, strict=True):
        assert difference[2:] == pytest.approx(other[2:])
    assert found.angle_rms == pytest.approx(expected.angle_rms)


def test_units_without_a_conversion_are_refused_with_a_remedy(two_calibrations, points):
    new, old = two_calibrations
    with pytest.raises(ValueError, match=r"counts .* with the same unit options"):
        differences(new, dataclasses.replace(old, unit="counts"), points)
    with pytest.raises(ValueError, match="--field-strength"):
        differences(new, dataclasses.replace(old, field_unit="counts"), points)


def test_unknown_errors_are_shown_as_unknown(two_calibrations, points):
    new, old = two_calibrations
    nothing = (math.nan,) * 3
    unknown = dataclasses.replace(old, center_se=nothing, semi_axes_se=nothing, matrix_se=(nothing,) * 3)
    found = differences(new, unknown, points)
    assert found.beyond == ()
    assert "no standard errors" in difference_sentences(found)[0]
    assert {row[-1] for row in difference_rows(found)} == {"?"}
    assert "nan" not in " ".join(" ".join(row) for row in difference_rows(found))
    half = dataclasses.replace(old, center=(99.0, *old.center[1:]), matrix_se=((math.nan,) * 3,) * 3)
    assert [difference.name for difference in differences(new, half, points).beyond] == ["offset x"]


def test_many_differences_are_counted(two_calibrations, points):
    new, _ = two_calibrations
    other = dataclasses.replace(new, matrix=tuple(tuple(1.1 * v for v in row) for row in new.matrix))
    sentence = difference_sentences(differences(new, other, points))[0]
    assert "matrix" in sentence
    assert sentence.count("matrix") == 3


def test_a_gain_of_all_axes_changes_the_radius_alone(points):
    """Each calibration corrects to its own measured length, so their matrices are equal."""
    new, old = calibrate(recorded(1.02 * points)), calibrate(recorded(points))
    radius = [difference for difference in differences(new, old, points).beyond if difference.name == "radius"]
    assert radius[0].new == pytest.approx(1.02 * old.radius, rel=1e-3)
    assert not [
        difference for difference in differences(new, old, points).beyond if difference.name.startswith("matrix")
    ]
