"""The common test case of all effects of the catalogue, and of users' own effects.

A new effect of the catalogue is tested automatically. An effect that is not linear in its amplitude, or whose
amplitudes have no unit, must be entered in a list here.
"""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.effects import (
    Effect,
    beyond,
    curve_within,
    lagged,
    played,
    rate_limited,
    resampled,
    shifted,
    soft_clip,
    travelled,
)
from mkc_torch.effects.kinds import absolute_zero
from mkc_torch.effects.waveforms import outer_product
from mkc_torch.simulation.dynamics.ports import memory_at
from mkc_torch.simulation.ports import SignalSizes
from tests.effects.contexts import contexts_of, kinds_of_shapes, size_of

NONLINEAR = ("delay", "clock_drift", "sensor_clock_drift", "backlash", "driver_parameter_arrhenius")
"""Effects on an output or a parameter that are not linear in γ: a time, a gap, or an exponent."""


def is_nonlinear(effect):
    return effect.id in NONLINEAR and effect.port != "input"


UNITLESS = ("share", "share_of_load", "gain_error", "gain_at_mean", "gain_change", "rate")
"""Names of quantities without a unit."""

DECLARED_FOLLOWS_SIGNAL = {
    "constant_change": True,
    "constant_force": True,
    "driver_force": True,
    "heading_reset": False,
}
"""Exceptions of ``follows_signal``: all effects on a rate have it; the signal of a heading has no noise."""


def cases(effects):
    """An effect, a shape and a context, for :class:`OfEveryShape`."""
    for effect in effects:
        for place, context in enumerate(contexts_of(effect)):
            for k, shape in enumerate(kinds_of_shapes(effect, context)):
                yield pytest.param(effect, shape, context, id=f"{type(effect).__name__}-{effect.plot_axis}-{place}-{k}")


def over_all_cases(cases):
    """Return a decorator of a class: each of its tests runs over all cases and names the failing case.

    Args:
        cases: a function that returns the cases, with their arguments and names.
    """

    def over_cases(check):
        def named(self, case):
            try:
                check(self, *case.values)
            except AssertionError as error:
                raise AssertionError(f"{case.id}: {error}") from error

        def test(self):
            for case in cases():
                named(self, case)

        return test

    def decorated(cls):
        for name in [name for name in dir(cls) if name.startswith("test_")]:
            setattr(cls, name, over_cases(getattr(cls, name)))
        return cls

    return decorated


def random_gammas(count, size):
    generator = torch.Generator().manual_seed(0)
    return 0.05 * torch.randn(count, size, generator=generator, dtype=torch.float64)


class OfEveryEffect:
    """Tests of an effect, with the argument ``effect``."""

    def test_an_effect_has_an_id_a_port_and_roles(self, effect):
        assert isinstance(effect, Effect)
        assert effect.id.isidentifier()
        assert effect.port
        assert isinstance(effect.roles, tuple)
        assert isinstance(effect.needs, tuple)

    def test_texts_for_the_user_are_sentences(self, effect):
        assert "=" in effect.equation
        for sentence in (effect.explanation, effect.advice):
            assert sentence.endswith(".")
            assert sentence[0].isupper()
        assert len(effect.source) > 5
        assert effect.plausible > 0.0

    def test_display_name_is_in_words(self, effect):
        assert effect.display_name.strip() == effect.display_name != ""
        assert "_" not in effect.display_name

    def test_recurrence_is_a_clause(self, effect):
        assert effect.recurrence == "" or (effect.recurrence[0].islower() and not effect.recurrence.endswith("."))

    def test_bounds_contain_zero(self, effect):
        assert effect.lower < effect.upper
        assert effect.lower <= 0.0 <= effect.upper
        assert effect.one_sided == (effect.lower == 0.0)

    def test_declarations_name_existing_shape_parameters(self, effect):
        # with a length of 1 s, shares of the length are times
        shapes = effect.shapes(torch.linspace(0.0, 1.0, 100).double())
        assert shapes
        numbers = {name for shape in shapes for name in shape}
        for declared in (effect.relative, effect.continuous, effect.fitted_shape, effect.form_parameters):
            assert set(declared) <= numbers
        assert all(which in SignalSizes._fields for _, which in effect.relative.values())
        assert all(low < high for low, high in effect.continuous.values())
        for name, (low, high) in effect.fitted_shape.items():
            grid = [shape[name] for shape in shapes]
            assert low <= min(grid) <= max(grid) < high
        assert not set(effect.shape_units) & set(effect.relative)
        assert all(effect.shape_units[name] == "s" for name in effect.continuous)

    def test_simpler_form_equals_equal_amplitudes(self, effect):
        simpler = effect.simpler
        if simpler is None:
            assert type(effect).simpler is Effect.simpler
            return
        assert (simpler.id, simpler.display_name, simpler.port) == (effect.id, effect.display_name, effect.port)
        for context in contexts_of(effect):
            assert simpler.shapes(context.time) == effect.shapes(context.time)
            for shape in effect.shapes(context.time):
                sizes = [size_of(form, shape, context) for form in (simpler, effect)]
                gamma = random_gammas(1, sizes[0])[0]
                each = gamma.repeat_interleave(sizes[1] // sizes[0])
                alike = [form.change(g, shape, context) for form, g in ((simpler, gamma), (effect, each))]
                torch.testing.assert_close(*alike)


class OfEveryShape:
    """Tests of an effect with a shape in a context, with the arguments ``effect``, ``shape`` and ``context``."""

    def test_zero_amplitude_changes_nothing(self, effect, shape, context):
        change = effect.change(random_gammas(1, size_of(effect, shape, context))[0] * 0.0, shape, context)
        assert change.shape == (len(context.time), len(context.channels))
        assert change.dtype == torch.float64
        assert float(change.abs().max()) <= (1e-12 if is_nonlinear(effect) else 0.0)

    def test_change_is_linear_in_the_amplitude(self, effect, shape, context):
        a, b = random_gammas(2, size_of(effect, shape, context))
        together = effect.change(2.0 * a - 3.0 * b, shape, context)
        parts = 2.0 * effect.change(a, shape, context) - 3.0 * effect.change(b, shape, context)
        largest = float(parts.abs().max())
        assert largest > 1e-4
        assert (float((together - parts).abs().max()) > 1e-6 * largest) == is_nonlinear(effect)
        if not is_nonlinear(effect):
            torch.testing.assert_close(together, parts, rtol=1e-9, atol=1e-9 * largest)

    def test_tangents_of_amplitudes_are_independent(self, effect, shape, context):
        size = size_of(effect, shape, context)
        gamma = torch.full((size,), 0.0123, dtype=torch.float64)
        tangent = torch.func.jacfwd(lambda g: effect.change(g, shape, context))(gamma)
        assert tangent.shape == (len(context.time), len(context.channels), size)
        h = 1e-6 if effect.id in NONLINEAR else 1e-3
        steps = h * torch.eye(size, dtype=torch.float64)
        near = [effect.change(gamma + s, shape, context) - effect.change(gamma - s, shape, context) for s in steps]
        near = torch.stack(near, -1) / (2.0 * h)
        torch.testing.assert_close(tangent, near, rtol=1e-5, atol=1e-6 * float(near.abs().max()))
        assert int(torch.linalg.matrix_rank(tangent.flatten(0, 1))) == size

    def test_derivative_by_the_signal_is_finite(self, effect, shape, context):
        """Trajectories are solved by Newton's method, also at standstill."""
        gamma = torch.ones(size_of(effect, shape, context), dtype=torch.float64)
        for values in (context.signal, torch.zeros_like(context.signal), 1e4 * context.signal):
            slope = torch.func.jvp(
                lambda s: effect.change(gamma, shape, replace(context, signal=s)), (values,), (torch.ones_like(values),)
            )[1]
            assert bool(slope.isfinite().all())

    def test_follows_signal_is_declared(self, effect, shape, context):
        gamma = random_gammas(1, size_of(effect, shape, context))[0]
        doubled = replace(context, signal=2.0 * context.signal)
        follows = not torch.equal(effect.change(gamma, shape, context), effect.change(gamma, shape, doubled))
        assert effect.follows_signal == DECLARED_FOLLOWS_SIGNAL.get(effect.id, follows)

    def test_derivative_by_fitted_shape_parameters(self, effect, shape, context):
        gamma = torch.ones(size_of(effect, shape, context), dtype=torch.float64)
        assert set(effect.fitted_shape) <= set(shape)
        for name in effect.fitted_shape:
            value = torch.tensor(float(shape[name]), dtype=torch.float64)

            def changed(at, name=name):
                return effect.change(gamma, {**shape, name: at}, context)

            slope = torch.func.jacfwd(changed)(value)
            step = 1e-6 * (value.abs() + (value == 0.0))
            numerical = (changed(value + step) - changed(value - step)) / (2.0 * step)
            largest = float(numerical.abs().max())
            assert largest > 0.0
            torch.testing.assert_close(slope, numerical, rtol=1e-4, atol=1e-4 * largest)

    def test_amplitudes_have_names_and_units(self, effect, shape, context):
        quantities = effect.quantities(shape, context)
        assert len({quantity.name for quantity in quantities}) == len(quantities)
        for quantity in quantities:
            assert quantity.name.isidentifier()
            assert quantity.size > 0
            assert (quantity.unit == "") == (quantity.name in UNITLESS)
            assert len(effect.components(quantity.name, shape, context)) in (0, quantity.size)

    def test_shape_parameters_have_units(self, effect, shape, context):
        assert effect.unit_of_shape("none of its numbers", context) == ""
        for name in shape:
            unit = effect.unit_of_shape(name, context)
            if name in effect.relative:
                part = effect.relative[name][0]
                assert unit == (context.units[0] if part == "driver" else context.unit_of(part)) != ""
            else:
                assert unit == effect.shape_units.get(name, unit)
            assert unit == "s" or name not in effect.continuous

    def test_equation_has_the_form_of_the_shape(self, effect, shape, context):
        equation = effect.equation_of(shape, context)
        assert equation.startswith(effect.equation.partition("=")[0])
        assert not any(word in equation for word in ("terms", "degree", "radius", "power", "order", "width =", "nan"))
        assert all(effect.reports(name) == (name not in effect.form_parameters) for name in shape)

    def test_moments_ascend_within_the_recording(self, effect, shape, context):
        moments = effect.moments(context)
        assert list(moments) == sorted(set(moments))
        assert all(float(context.time[0]) <= moment <= float(context.time[-1]) for moment in moments)
        assert bool(moments) == (type(effect).moments is not Effect.moments)

    def test_bind_is_idempotent(self, effect, shape, context):
        bound = effect.bind(shape, context)
        assert effect.bind(bound, context) == bound
        assert bound.items() >= shape.items()
        gamma = random_gammas(1, size_of(effect, shape, context))[0]
        torch.testing.assert_close(effect.change(gamma, bound, context), effect.change(gamma, shape, context))

    def test_basis_and_waveform_equal_the_change(self, effect, shape, context):
        gamma = random_gammas(1, size_of(effect, shape, context))[0]
        change = effect.change(gamma, shape, context)
        if effect.has_basis:
            torch.testing.assert_close(effect.basis(shape, context) @ gamma, change)
        else:
            with pytest.raises(NotImplementedError, match="`basis`"):
                effect.basis(shape, context)
        if effect.has_waveform:
            assert torch.equal(outer_product(effect.waveform(shape, context), gamma), change)

    def test_lasting_change_is_zero_without_an_amplitude(self, effect, shape, context):
        gamma = random_gammas(1, size_of(effect, shape, context))[0]
        if not effect.persistent_change:
            with pytest.raises(NotImplementedError, match="`lasting`"):
                effect.lasting(gamma, context)
            return
        left = effect.lasting(gamma, context)
        assert left.shape == (len(context.time), len(context.channels))
        assert torch.equal(left[-1], effect.change(gamma, shape, context)[-1])
        assert effect.follows_signal or torch.equal(left, left[-1].expand_as(left))
        assert not bool(effect.lasting(0.0 * gamma, context).any())

    def test_code_equals_the_change(self, effect, shape, context):
        gamma = random_gammas(1, size_of(effect, shape, context))[0].abs()
        if not effect.has_code:
            with pytest.raises(NotImplementedError, match="`code`"):
                effect.code(gamma.tolist(), shape, {})
            return
        carried = context.carries or context.channels
        inner = ("memory", "memory_2")[: len(memory_at(effect.port, "speed"))]
        if inner:  # internal states are solved jointly
            more = [(k * context.time).cos() for k, _ in enumerate(inner, start=1)]
            context = replace(context, signal=torch.cat([context.signal, torch.stack(more, -1)], -1))
        x = SimpleNamespace(**dict(zip((*carried, *inner), context.signal.unbind(-1), strict=True)))
        names = {part: f"x.{name}" for part, name in context.parts.items()} | {name: f"x.{name}" for name in inner}
        names["zero"] = "273.15" if context.unit_of("own") == "°C" else "0.0"
        if set(effect.needs) <= {"driven"} and effect.port == "output":  # it acts on all outputs
            names = {name: f"x.{name}" for name in carried}
        if context.units:
            means = context.driver_means or (0.0,)
            names |= {"recorded": "d", "driver": f"(d - {means[0]!r})"}
            names["zero_of_driver"] = "273.15" if context.units[0] == "°C" else "0.0"
            names["mean"] = repr(means[0])
            names["absolute_mean"] = repr(means[0] + absolute_zero(context.units[0], means[0]))
        known = {"x": x, "torch": torch, "time": context.time, "run": context.runs}
        known |= {"d": context.recorded} if context.units else {}
        known |= {"lagged": lagged, "shifted": shifted, "played": played, "soft_clip": soft_clip, "beyond": beyond}
        known |= {
            "rate_limited": rate_limited,
            "curve_within": curve_within,
            "travelled": travelled,
            "resampled": resampled,
        }
        shape = {name: float(value) for name, value in shape.items()}
        lines = effect.code(gamma.tolist(), shape, names)
        written = torch.stack([eval(line, known) + torch.zeros_like(context.time) for line in lines], -1)
        torch.testing.assert_close(written, effect.change(gamma, shape, context), rtol=1e-9, atol=1e-9)
