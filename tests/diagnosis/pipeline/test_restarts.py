"""A simulation whose free run leaves the recording is fitted in segments, if it follows them by its physics."""

import json
import math
from time import monotonic

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions, prepare
from mkc_torch.diagnosis.pipeline.restarts import (
    restarted_problem,
    segment_lengths,
    segment_polynomials,
    with_restarts_stated,
    without_restarts_stated,
)
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE
from tests.diagnosis.duffing import Duffing, PullingBack, duffing_recording
from tests.diagnosis.factory import make_diagnosis


def restarted(simulation, recording, effects=()):
    """Return the problem of a diagnosis with restarts; None if the simulation does not follow in segments."""
    problem = prepare(simulation, recording, effects, SearchOptions(0.05, 19, 3, 0, Settings()), None, lambda _: None)
    return restarted_problem(problem, recording, math.inf, monotonic())


def test_segments_are_halves_of_the_longest_run_down_to_few_samples():
    time = 0.1 * torch.arange(300, dtype=torch.float64)
    begins = torch.zeros(300, dtype=torch.bool)
    begins[[0, 100]] = True
    assert segment_lengths(time, begins, 2) == (9.95, 4.975, 2.488)
    assert segment_lengths(time, begins, 9) == (9.95,)
    assert segment_lengths(1e6 * time, begins, 9) == (9.95e6,)


def test_polynomials_are_those_of_numpy_in_each_segment():
    random = np.random.default_rng(0)
    values, time = random.standard_normal((30, 2)), np.cumsum(random.uniform(0.5, 1.5, 30))
    begins = torch.zeros(30, dtype=torch.bool)
    begins[[0, 12]] = True
    left = segment_polynomials(torch.as_tensor(values), torch.as_tensor(time), begins, 3)
    for part in (slice(0, 12), slice(12, 30)):
        for k in range(2):
            fit = np.polynomial.Polynomial.fit(time[part], values[part, k], 2)
            np.testing.assert_allclose(left[part, k].numpy(), values[part, k] - fit(time[part]), atol=1e-10)


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [0, 1])
def test_a_chaotic_simulation_follows_in_segments(seed):
    assert restarted(Duffing(), duffing_recording(seed, 400)) is not None


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("simulation", "unrelated"), [(PullingBack, False), (Duffing, True)], ids=["wrong sign", "unrelated outputs"]
)
def test_a_wrong_simulation_does_not_follow_in_segments(simulation, unrelated):
    recording = duffing_recording(0, 400, unrelated=unrelated)
    assert restarted(simulation(), recording) is None


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [0, 1])
def test_a_chaotic_simulation_does_not_follow_with_an_input_of_another_phase(seed):
    recording = duffing_recording(seed, 400)
    columns = {name: recording[name] for name in recording.names}
    shifted = Recording({**columns, "shaking": recording["shaking"].roll(26)})
    assert restarted(Duffing(), shifted) is None


@pytest.mark.e2e
def test_friction_of_a_chaotic_oscillator_is_found_with_restarts_and_these_are_stated():
    few = [effect for effect in CATALOGUE if effect.id in ("coulomb_friction", "linear_drag", "constant_force")]
    recording = duffing_recording(0, 400)
    again = restarted(Duffing(), recording, few)
    assert again is not None
    found = with_restarts_stated(diagnose(again.simulation, recording, effects=few, surrogates=19), again, found=False)
    assert found.findings[0].effect == "coulomb_friction"
    assert found.findings[0].parameters[0].value == pytest.approx(0.15, rel=0.1)
    seconds = found.environment.restart_after
    assert seconds == again.simulation.restart_after
    assert f"restarted every {seconds:.4g} s" in found.warnings[0]
    assert json.loads(diagnosis_to_json(found))["search"]["restart_after"] == seconds
    assert f"restart_after = {seconds!r}" in found.model.to_python("shakers")


def problem_of(simulation):
    options = SearchOptions(0.05, 19, 3, 0, Settings())
    return prepare(simulation, duffing_recording(0, 100), (), options, None, lambda _: None)


def test_the_segments_that_were_tried_are_noted():
    result, free = make_diagnosis(0, verdict="unfit"), problem_of(Duffing())
    (none,) = set(without_restarts_stated(result, free, None).notes) - set(result.notes)
    assert "do not follow the recording" in none
    (some,) = set(without_restarts_stated(result, free, problem_of(Duffing().with_restarts(2.5))).notes) - set(
        result.notes
    )
    assert "segments of 2.5 s" in some
    assert "`restart_after = 2.5`" in some
    assert without_restarts_stated(result, problem_of(Duffing().with_restarts(2.0)), None) is result


def test_restarts_of_the_user_have_precedence():
    recording = duffing_recording(0, 100)
    own = Duffing().with_restarts(2.0)
    assert restarted(own, recording) is None
