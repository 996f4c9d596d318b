"""The device checks run on the CPU at tiny sizes, so that they also work on a GPU."""

import sys

import pytest
import torch

from mkc_torch._support.side_by_side import forced
from mkc_torch.linear import LeastSquares, MKCRegression, SRegression
from tests.device import __main__, other_fits, small_fits

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _few_estimators(monkeypatch):
    some = {k: v for k, v in small_fits.ESTIMATORS.items() if k in ("LeastSquares", "MKCRegression", "SRegression")}
    monkeypatch.setattr(small_fits, "ESTIMATORS", some)


def test_small_fits_agree_and_print_a_row_for_each_estimator(capsys):
    with forced():
        assert small_fits.print_small_fits(CPU, many=3, few=2, compared=2, ellipsoids=2)
    printed = capsys.readouterr().out
    assert printed.count("MKCRegression") == 2
    assert "a million in" in printed


def test_a_wrong_device_result_is_reported():
    X, y = small_fits.problems(CPU, 2, 30, 2)
    fit = SRegression().fit(X, y)
    assert small_fits.agreement(SRegression, fit, X, y) == (1.0, True)
    fit.coef_ = fit.coef_ + 0.1
    assert small_fits.agreement(SRegression, fit, X, y) == (0.0, False)
    fit = MKCRegression().fit(X, y)
    fit.coef_, fit.log_likelihood_ = fit.coef_ + 0.1, fit.log_likelihood_ - 1.0
    assert small_fits.agreement(MKCRegression, fit, X, y) == (0.0, False)


def test_errors_of_an_estimator_are_printed_and_fail(monkeypatch, capsys):
    class Failing(LeastSquares):
        def fit(self, *data):
            raise RuntimeError("CUSOLVER_STATUS_INTERNAL_ERROR")

    monkeypatch.setattr(small_fits, "ESTIMATORS", {"Failing": (Failing, 1.0)})
    assert not small_fits.print_small_fits(CPU, many=2, few=2, compared=2, ellipsoids=1)
    assert "RuntimeError: CUSOLVER" in capsys.readouterr().out


def test_the_command_runs_the_section(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["tests.device", "--device", "cpu", "--only", "small_fits"])
    __main__.main()
    assert "us a fit" in capsys.readouterr().out


def test_other_fits_agree_where_the_path_of_a_gpu_is_forced(monkeypatch, capsys):
    with forced():
        assert other_fits.print_other_fits(CPU)
    assert "ellipsoids" in capsys.readouterr().out
    # a result that differs fails the check
    values = iter([torch.ones(2), torch.tensor([1.0, 1.1])])
    monkeypatch.setattr(other_fits, "WORK", {"one": lambda _device: next(values)})
    assert not other_fits.print_other_fits(CPU)
