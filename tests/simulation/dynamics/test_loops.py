"""Loops over samples agree in Python, machine code and NumPy."""

import subprocess
import sys

import numpy as np
import pytest

from mkc_torch.simulation.dynamics import kalman, whitening
from mkc_torch.simulation.dynamics.compiled import affine
from mkc_torch.simulation.dynamics.compiled.affine import Affine
from mkc_torch.simulation.dynamics.kalman import run_filter, start_of
from mkc_torch.simulation.dynamics.loops.kalman_filter import filter_samples
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code
from mkc_torch.simulation.dynamics.loops.recurrence import pass_on
from mkc_torch.simulation.dynamics.loops.whiten import whiten_samples
from mkc_torch.simulation.dynamics.whitening import SeriesAlong, gains_of, whitened
from tests.simulation.dynamics.oscillating import flow
from tests.simulation.dynamics.test_kalman import MODELS, TWO_OUTPUTS, batch, model
from tests.simulation.dynamics.test_parallel_filter import recorded

WAYS = {"machine code": machine_code, "Python": lambda loop: loop, "NumPy": lambda _: None}


def in_each_way(monkeypatch, module, compute):
    """Return the results by machine code, by the loop in Python, and by NumPy."""
    found = []
    for way in WAYS.values():
        with monkeypatch.context() as patch:
            patch.setattr(module, "machine_code", way)
            found.append(compute())
    return found


def assert_alike(found):
    first, *others = found
    for other in others:
        for array, expected in zip(other, first, strict=True):
            np.testing.assert_allclose(array, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max(initial=1e-300))


@pytest.fixture
def oscillator_flow():
    return recorded(flow(60, TWO_OUTPUTS, runs=2))


def test_numba_is_installed_with_the_tests():
    assert all(machine_code(loop) is not None for loop in (filter_samples, whiten_samples, pass_on))


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize("given", [True, False])
def test_filters_by_python_machine_code_and_numpy_agree(oscillator_flow, keep, given, monkeypatch):
    models = batch(model(white=2.0, sensor=(0.1, 0.2)), model(white=0.5, sensor=(0.3, 0.1)))

    def filtered():
        start = start_of(np.full((1, 2, 2), 0.3), models) if given else None
        left, end = run_filter(oscillator_flow.whole, models, keep=keep, start=start)
        last = (end.state, end.covariance, *((end.kept,) if given else ()))
        return left.standard, left.log_spread, left.prior, left.state, left.after, left.posterior, *last

    assert_alike(in_each_way(monkeypatch, kalman, filtered))


@pytest.mark.parametrize("name", MODELS)
def test_whitened_series_by_python_machine_code_and_numpy_agree(name, monkeypatch):
    along, random = recorded(flow(40, runs=2)), np.random.default_rng(1)
    gains = gains_of(along, MODELS[name])
    series = SeriesAlong(random.standard_normal((*along.new.shape, 3)), random.standard_normal((*along.shift.shape, 3)))

    def innovations():
        return [values.copy() for _, values in whitened(along, gains, series)]

    assert_alike(in_each_way(monkeypatch, whitening, innovations))


def test_recurrences_by_python_machine_code_and_numpy_agree(monkeypatch):
    random = np.random.default_rng(2)
    carries = 0.5 * random.standard_normal((2, 2, 400))
    carries[..., [0, 150]] = 0.0
    source = random.standard_normal((2, 3, 400))
    kept = source.copy()
    found = in_each_way(monkeypatch, affine, lambda: [Affine.of(carries, 250).solved(source)])
    assert_alike(found)
    np.testing.assert_array_equal(source, kept)
    expected = source[..., 1] + carries[..., 1] @ source[..., 0]
    np.testing.assert_allclose(found[0][0][..., 1], expected, rtol=1e-12)


@pytest.mark.process
@pytest.mark.parametrize("hidden", ["import os; os.environ['MKC_WITHOUT_NUMBA'] = '1'", "sys.modules['numba'] = None"])
def test_numpy_is_the_fallback_without_numba(hidden):
    code = f"import sys; {hidden}; from {machine_code.__module__} import machine_code; print(machine_code(len))"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert printed.stdout.strip() == "None"
