"""Tangents of candidates in blocks: the same as all at once, with bounded memory."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.search import linearise as projection
from mkc_torch.diagnosis.search import tangents as blocks
from mkc_torch.diagnosis.search.linearise import linearise
from mkc_torch.diagnosis.search.tangents import Candidates, one_after_the_other, tangents_of
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording import demonstration
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.line import Line
from tests.diagnosis.search.test_run import STEPS


@pytest.fixture(scope="module")
def sensor():
    """Return a magnetometer's fit, and all candidates."""
    recording, _ = demonstration.simulated_recording(0)
    prepared = Magnetometer("norm").prepare(recording)
    drivers = find_drivers(recording, Magnetometer("norm").columns, Settings().drivers)
    fit = fitted(JointModel(prepared), prepared.start())
    return fit, candidate_terms(prepared, drivers.drivers, CATALOGUE)


class Largest(TorchDispatchMode):
    """Record the size of the largest tensor that an operation creates."""

    numbers = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        several = made if isinstance(made, (tuple, list)) else [made]
        own = [tensor for tensor in several if isinstance(tensor, torch.Tensor) and not tensor._is_view()]
        self.numbers = max([self.numbers, *(tensor.numel() for tensor in own)])
        return made


def tangents_at(fit, terms):
    return tangents_of(fit.model, fit.parameters, Settings().noise, terms)


def test_tangents_are_derivatives_of_the_joint_residual(sensor):
    fit, terms = sensor
    found = tangents_at(fit, terms).candidates
    assert len(found) == len(terms)
    kinds = {term.effect.id: number for number, term in enumerate(terms)}
    assert len(kinds) >= 3
    independent = torch.tensor(fit.model.prepared.independent, dtype=torch.float64)
    for number in kinds.values():
        model = fit.model.with_term(terms[number])
        zero = torch.zeros(model.size - fit.model.size, dtype=torch.float64)
        slope = torch.func.jacfwd(model.residual)(torch.cat([fit.parameters, zero]))[..., fit.model.size :]
        slope = independent[:, None] * slope if terms[number].effect.follows_signal else slope
        torch.testing.assert_close(found[number], slope, rtol=1e-9, atol=1e-9)


def test_recomputed_tangents_equal_cached_tangents(sensor, monkeypatch):
    fit, terms = sensor
    held = tangents_at(fit, terms).candidates
    assert len(held._held) == len(terms)
    monkeypatch.setattr(blocks, "HELD", 0)
    made = tangents_at(fit, terms).candidates
    assert not made._held
    for number in range(len(terms)):
        assert torch.equal(held[number], made[number])
    assert [tangent.shape for tangent in made[2:5]] == [held[number].shape for number in (2, 3, 4)]
    assert made[-1].equal(held[len(terms) - 1])


def test_the_cache_is_limited(sensor, monkeypatch):
    fit, terms = sensor
    widest = max(tangent.numel() for tangent in tangents_at(fit, terms).candidates)
    monkeypatch.setattr(blocks, "HELD", 100_000)
    held = sum(tangent.numel() for tangent in tangents_at(fit, terms).candidates._held.values())
    assert 100_000 <= held < 100_000 + widest


def test_trajectories_are_solved_once_for_all_blocks(monkeypatch):
    monkeypatch.setattr(blocks, "HELD", 0)
    line = Line(200)
    fit = fitted(JointModel(line), line.start())
    found = Candidates(fit.model, fit.parameters, STEPS, dict.fromkeys(line.ports))
    assert len(found._held) == len(STEPS)
    assert found[0] is found[0]


def test_a_search_in_small_blocks_gives_the_same_gains(sensor, monkeypatch):
    fit, terms = sensor
    values, counts = fit.pseudo(Settings().noise)

    def gains():
        search = linearise(fit.model, fit.parameters, values, counts, tangents_at(fit, terms))
        return search.search.gains(search.series.unsqueeze(-1)).ratio

    whole = gains()
    monkeypatch.setattr(blocks, "HELD", 0)
    monkeypatch.setattr(blocks, "CELLS", 1)
    monkeypatch.setattr(projection, "FILLED_AT_ONCE", 1)
    torch.testing.assert_close(gains(), whole, rtol=1e-9, atol=1e-9)


def test_no_tensor_holds_all_candidates_of_a_long_recording(monkeypatch):
    N = 50_000
    line = Line(N)
    model, terms = JointModel(line), STEPS[:1] * 60
    parameters = line.start()
    pseudo = torch.zeros(N, 1, dtype=torch.float64)
    monkeypatch.setattr(blocks, "HELD", 0)
    monkeypatch.setattr(blocks, "CELLS", 1_000_000)
    with Largest() as largest:
        tangents = tangents_of(model, parameters, Settings().noise, terms)
        found = projection.CosineProjection.of(pseudo, torch.ones_like(pseudo), tangents, None)
    widths = sum(tangent.shape[-1] for tangent in found.candidates)
    assert widths == sum(tangent.shape[-1] for tangent in tangents.candidates) >= 60
    assert found.kept < N // 20
    # a block has at most that many numbers plus a candidate's
    bound = 1_000_000 + tangents.candidates[0].numel()
    assert largest.numbers <= 1.01 * bound < 0.2 * N * line.residual(parameters, {}).shape[1] * widths


def test_several_sets_are_a_single_sequence(sensor):
    fit, terms = sensor
    first, second = tangents_at(fit, terms[:3]).candidates, tangents_at(fit, terms[3:5]).candidates
    both, whole = one_after_the_other(first, second), tangents_at(fit, terms[:5]).candidates
    assert len(both) == 5
    assert all(torch.equal(a, b) for a, b in zip(both, whole, strict=True))
    assert [tangent.shape for tangent in both[2:4]] == [tangent.shape for tangent in whole[2:4]]
    with pytest.raises(IndexError):
        both[5]
