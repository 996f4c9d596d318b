"""Empty recordings have the noise of their kind, and the table of their p-values equals SciPy's."""

import json

import numpy as np
import pytest
import torch
from scipy import stats

pytest.importorskip("matplotlib")

from tests.gate import null_p_values, null_recordings
from tests.gate.null_recordings import KINDS, NOISE, SAMPLES, STEP, Spring, recording


def ensemble(kind, part, count=300):
    """(T, count) sensor errors (part 0) or process noise (part 1)."""
    return np.stack([KINDS[kind][part](np.random.default_rng([7, k])) for k in range(count)], -1)


def autocorrelation(values, lag):
    """Autocorrelation of stationary series at a lag in samples, over an ensemble."""
    return (values[lag:] * values[:-lag]).mean() / values.var()


def test_the_same_seed_gives_the_same_recording_and_each_kind_has_its_own():
    item, again, other = recording("white", 3), recording("white", 3), recording("white", 4)
    torch.testing.assert_close(item["place"], again["place"], rtol=0, atol=0)
    assert not torch.equal(item["place"], other["place"])
    assert len({float(recording(kind, 3)["place"][5]) for kind in KINDS}) == len(KINDS)


def test_sensor_errors_have_the_correlation_of_their_kind():
    white, slow, ar = (ensemble(kind, 0) for kind in ("white", "slow sensor error", "autoregressive sensor"))
    assert white.std() == pytest.approx(NOISE, rel=0.03)
    assert abs(autocorrelation(white, 1)) < 0.03
    assert autocorrelation(ar, 1) == pytest.approx(null_recordings.AR, abs=0.03)
    assert autocorrelation(ar, 3) == pytest.approx(null_recordings.AR**3, abs=0.05)
    share = null_recordings.SLOW_SIZE**2 / (null_recordings.SLOW_SIZE**2 + NOISE**2)
    samples = null_recordings.SLOW_SHARE * SAMPLES
    assert autocorrelation(slow, 5) == pytest.approx(share * np.exp(-5.0 / samples), abs=0.05)


def test_disturbances_are_white_or_correlated():
    white, lasting = (ensemble(kind, 1) for kind in ("process noise, white", "process noise, lasting"))
    assert abs(autocorrelation(white, 1)) < 0.03
    samples = null_recordings.LASTING_SHARE * SAMPLES
    assert autocorrelation(lasting, 40) == pytest.approx(np.exp(-40.0 / samples), abs=0.1)
    assert not ensemble("white", 1, 2).any()


def simulated_place(held, force, disturbance=None):
    disturbance = np.zeros(SAMPLES) if disturbance is None else disturbance
    return null_recordings._simulated_place(force, disturbance, held, np.array([0.2, -0.1]))


@pytest.mark.parametrize("held", [False, True])
def test_the_simulated_place_equals_scipy(held):
    from scipy.signal import StateSpace, lsim

    random = np.random.default_rng(1)
    force, time = random.standard_normal(SAMPLES), STEP * np.arange(SAMPLES)
    system = StateSpace([[0.0, 1.0], [-4.0, -0.5]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    _, expected, _ = lsim(system, force, time, X0=[0.2, -0.1], interp=not held)
    np.testing.assert_allclose(simulated_place(held, force), expected, atol=0.01 * NOISE)


def test_a_disturbance_exceeds_the_measurement_noise():
    force = np.zeros(SAMPLES)
    for kind in ("process noise, white", "process noise, lasting"):
        disturbance = KINDS[kind][1](np.random.default_rng(2))
        assert (simulated_place(False, force, disturbance) - simulated_place(False, force)).std() > 2.0 * NOISE


def test_interval_and_distance_equal_scipy():
    values = np.random.default_rng(3).uniform(size=60).tolist()
    found = null_p_values.summary_row(values)
    below = sum(value <= 0.05 for value in values)
    interval = stats.binomtest(below, 60).proportion_ci(method="exact")
    assert (found["below"], found["recordings"]) == (below / 60, 60)
    assert (found["low"], found["high"]) == pytest.approx((interval.low, interval.high), abs=1e-6)
    test = stats.kstest(values, "uniform")
    assert found["distance"] == pytest.approx(test.statistic)
    assert found["uniform_p"] == pytest.approx(test.pvalue, abs=0.02)


def test_the_command_writes_table_picture_and_p_values_and_goes_on(tmp_path, monkeypatch, capsys):
    asked = []

    def cheap(empty, surrogates):
        asked.append((empty.name, surrogates))
        return 0.01 if empty.name == "white" else 0.5

    monkeypatch.setattr(null_p_values, "searched", cheap)
    command = ["--output", str(tmp_path), "--kinds", "white", "held inputs", "--surrogates", "39", "--per-kind"]
    assert null_p_values.main([*command, "1"]) == 0
    assert null_p_values.main([*command, "3"]) == 0
    assert set(null_p_values.run(tmp_path, ["white"], 3, {"seed": 1, "surrogates": 39})) == {"white", "held inputs"}
    assert asked == [("white", 39), ("held inputs", 39)] * 3  # the first pair is not searched again
    stored = json.loads((tmp_path / "p_values.json").read_text(encoding="utf-8"))
    assert stored["p_values"] == {"white": [0.01] * 3, "held inputs": [0.5] * 3}
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    white = next(line for line in lines if line.startswith("| white | 3 | 100.0 % | 29.2 to 100.0 % | 0.99 |"))
    held = next(line for line in lines if line.startswith("| held inputs | 3 | 0.0 % | 0.0 to 70.8 % | 0.50 |"))
    assert white.endswith("| 3 | 0 | 0 | 0 | 0 |")
    assert held.endswith("| 0 | 0 | 3 | 0 | 0 |")
    assert (tmp_path / "summary.md").read_text(encoding="utf-8") in printed
    page = (tmp_path / "null_p_values.svg").read_text(encoding="utf-8")
    assert "white (3)" in page
    assert "held inputs (3)" in page
    assert null_p_values.main(["--seed", "2", *command, "1"]) == 0
    assert len(asked) == 8  # another seed begins again


@pytest.mark.e2e
def test_the_p_value_equals_that_of_a_diagnosis_that_keeps_its_findings():
    """The table is therefore valid for `mkc diagnose`."""
    from mkc_torch import diagnose

    empty = recording("white", 5)
    assert null_p_values.searched(empty, 39) == diagnose(Spring(), empty, surrogates=39).p_value


@pytest.mark.e2e
def test_few_of_a_few_empty_recordings_are_below_the_level(tmp_path):
    """Three of six would be once in five hundred runs."""
    found = null_p_values.run(tmp_path, ["white", "held inputs"], 3, {"seed": 2, "surrogates": 39})
    assert sum(value <= 0.05 for values in found.values() for value in values) < 3
