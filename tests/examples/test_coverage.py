"""The example of intervals, at a small size."""

import importlib.util
from pathlib import Path

import pytest

pytestmark = pytest.mark.manual


@pytest.fixture(scope="module")
def example():
    path = Path(__file__).parents[2] / "examples" / "estimators" / "coverage.py"
    spec = importlib.util.spec_from_file_location("coverage_of_intervals", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_intervals_of_mm_cover_under_outliers_and_those_of_least_squares_do_not(example, capsys):
    sizes = ["--samples", "60", "--outliers", "0", "0.2", "--draws", "80"]
    example.main([*sizes, "--estimators", "least squares", "MM", "MM, homoscedastic"])
    rows = {
        line[:20].strip(): [float(v) for v in line[20:].split()] for line in capsys.readouterr().out.splitlines()[2:]
    }
    assert 90.0 <= rows["MM"][0] <= 98.0
    assert 90.0 <= rows["MM"][1] <= 98.0
    assert rows["least squares"][0] > 90.0 > 80.0 > rows["least squares"][1]
    # outliers far out in X do not belong to the design
    assert rows["MM, homoscedastic"][1] < 90.0


def test_sandwich_intervals_cover_under_heteroscedastic_errors(example):
    sandwich, alike = (
        example.coverage(name, 150, 0.0, draws=150, seed=1, errors="spread") for name in ("MM", "MM, homoscedastic")
    )
    assert sandwich > 0.92
    assert sandwich > alike + 0.01
