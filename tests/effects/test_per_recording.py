"""An effect with a size for each recording acts in each recording as the effect with this size does."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.effects import DYNAMICS, beyond, lagged, selected_size
from mkc_torch.effects.per_recording import PerRecording, can_differ
from tests.effects.contexts import contexts_of, kinds_of_shapes, size_of
from tests.effects.effect_case import over_all_cases, random_gammas

NAMES = ("a", "b")
RUNS = torch.tensor([1, 0, 1])  # the first and the last run are of the second recording


def cases():
    for effect in filter(can_differ, DYNAMICS):
        for place, context in enumerate(contexts_of(effect)):
            run = torch.arange(len(context.time)) * 3 // len(context.time)
            for k, shape in enumerate(kinds_of_shapes(effect, context)):
                yield pytest.param(effect, shape, replace(context, run=run), id=f"{type(effect).__name__}-{place}-{k}")


def gammas(effect, shape, context):
    """Return γ of the form with a size for each recording, and of each recording."""
    each = random_gammas(2, size_of(effect, shape, context))
    return torch.stack(list(each), -1).flatten(), each


@over_all_cases(cases)
class TestEveryEffectWhoseSizeCanDiffer:
    def test_the_change_in_each_recording_is_that_of_its_size(self, effect, shape, context):
        whole, each = gammas(effect, shape, context)
        found = PerRecording(effect, NAMES, RUNS).change(whole, shape, context)
        parts = [effect.change(gamma, shape, context) for gamma in each]
        of_second = (RUNS[context.run] == 1).unsqueeze(-1)
        torch.testing.assert_close(found, torch.where(of_second, parts[1], parts[0]))

    def test_a_difference_from_the_first_recording_changes_the_others_only(self, effect, shape, context):
        gamma = random_gammas(1, size_of(effect, shape, context))[0]
        form = PerRecording(effect, NAMES, RUNS, relative=True)
        found = form.change(gamma, shape, context)
        of_second = (RUNS[context.run] == 1).unsqueeze(-1)
        plain = effect.change(gamma, shape, context)
        torch.testing.assert_close(found, torch.where(of_second, plain, torch.zeros_like(plain)))
        assert torch.equal(form.gamma_of(gamma, "b"), gamma)
        assert torch.equal(form.gamma_of(gamma, "a"), torch.zeros_like(gamma))

    def test_the_basis_gives_the_change(self, effect, shape, context):
        form = PerRecording(effect, NAMES, RUNS)
        whole, _ = gammas(effect, shape, context)
        if form.has_basis:
            torch.testing.assert_close(form.basis(shape, context) @ whole, form.change(whole, shape, context))

    def test_each_number_has_the_name_of_its_recording(self, effect, shape, context):
        form = PerRecording(effect, NAMES, RUNS)
        for own, common in zip(form.quantities(shape, context), effect.quantities(shape, context), strict=True):
            assert (own.name, own.size, own.unit) == (common.name, 2 * common.size, common.unit)
            labels = form.components(own.name, shape, context)
            assert len(set(labels)) == own.size
            assert [label.split()[-1] for label in labels] == list(NAMES) * common.size

    def test_code_selects_the_size_of_a_recording(self, effect, shape, context):
        form = PerRecording(effect, NAMES, RUNS)
        assert form.has_code == effect.has_code
        if not effect.has_code or context.memories is not None:
            return
        shape = {name: float(value) for name, value in shape.items()}
        whole, each = gammas(effect, shape, context)
        names = dict.fromkeys((*context.parts, "driver", "recorded", "memory", "mean", "zero_of_driver", "zero"), "x.q")
        names |= {"mean": "2.0", "zero": "0.0", "zero_of_driver": "0.0", "absolute_mean": "2.0"}
        known = {"torch": torch, "x": SimpleNamespace(q=torch.tensor([0.7, -1.3])), "selected_size": selected_size}
        known |= {"time": torch.tensor([0.0, 1.0]), "run": torch.zeros(2, dtype=torch.long)}
        known |= {"lagged": lagged, "beyond": beyond}
        for name, gamma in zip(NAMES, each, strict=True):
            plain = [eval(line, known) for line in effect.code(gamma.tolist(), shape, names)]
            known["self"] = SimpleNamespace(sizes_of=name)
            chosen = [eval(line, known) for line in form.code(whole.tolist(), shape, names)]
            assert all(torch.equal(torch.as_tensor(a), torch.as_tensor(b)) for a, b in zip(plain, chosen, strict=True))


def test_curves_shares_and_effects_of_a_time_have_a_common_size():
    different = {effect.id for effect in DYNAMICS if can_differ(effect)}
    assert {"quadratic_drag", "coulomb_friction", "driver_parameter", "constant_force"} <= different
    assert not different & {"unknown", "power_law", "input_delay", "input_saturation", "sensor_clock_drift", "backlash"}


def test_no_recording_is_assumed_without_a_selection():
    with pytest.raises(ValueError, match=r"set its `sizes_of` to 'a' or 'b' \(`--sizes-of`\), not ''\."):
        selected_size(SimpleNamespace(sizes_of=""), {"a": 1.0, "b": 2.0})
    drag = next(effect for effect in DYNAMICS if effect.id == "quadratic_drag")
    context = contexts_of(drag)[0]
    with pytest.raises(ValueError, match="differs between a and b; select one of them"):
        PerRecording(drag, NAMES).change(torch.ones(2, dtype=torch.float64), {}, context)
