"""A cart with hidden drag and dry friction, integrated independently, and its fits in open loop."""

import functools
import math

import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import FittedModel, fitted, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

STEP, SAMPLES, FINE, NOISE = 0.05, 240, 50, 0.01
DRAG, FRICTION = 0.3, 0.2


class Cart(Dynamics):
    """A cart driven by a force, without drag and friction."""

    states = ("speed",)
    inputs = ("force",)
    parameters = {"gain": Parameter(1.0, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.force}


def cart_recording(
    drag: float = 0.0, friction: float = 0.0, seed: int = 0, samples: int = SAMPLES, mean: float = 1.0
) -> Recording:
    """Return a recording of a cart's speed; without a mean force it reverses, as dry friction needs."""
    clock = [STEP * k for k in range(samples)]
    force = [mean + math.sin(0.9 * t) if mean else 1.5 * math.cos(0.9 * t) + math.cos(2.3 * t) for t in clock]
    speed, found = 0.5 if mean else 0.1, []
    for k in range(samples):
        found.append(speed)
        ahead = force[min(k + 1, samples - 1)]
        for part in range(FINE):
            acting = force[k] + (ahead - force[k]) * (part + 0.5) / FINE
            lost = drag * speed * abs(speed) + friction * math.tanh(speed / 0.02)
            speed += STEP / FINE * (acting - lost)
    noise = NOISE * torch.randn(samples, generator=torch.Generator().manual_seed(seed)).double()
    columns = {"time": clock, "force": force, "speed": found}
    table = {name: torch.tensor(values, dtype=torch.float64) for name, values in columns.items()}
    return Recording({**table, "speed": table["speed"] + noise})


@functools.cache
def free_fit(drag: float = 0.0, friction: float = 0.0, mean: float = 1.0, samples: int = SAMPLES) -> FittedModel:
    """Fit the cart without effects in open loop."""
    prepared = Cart().prepare(cart_recording(drag, friction, samples=samples, mean=mean))
    return fitted(JointModel(prepared), prepared.start())


def cart_terms(fit: FittedModel, *names: str) -> tuple[Term, ...]:
    """Return the candidates of these effects, or of all."""
    return candidate_terms(fit.model.prepared, (), [e for e in DYNAMICS if not names or e.id in names])


def first_term(fit: FittedModel, name: str) -> Term:
    """Return the first candidate of an effect."""
    return cart_terms(fit, name)[0]


def fit_with(fit: FittedModel, term: Term) -> FittedModel:
    """Fit a model with one more effect, from size 0."""
    model = fit.model.with_term(term)
    start = torch.cat([fit.parameters, fit.parameters.new_zeros(model.size - fit.model.size)])
    return fitted_with_effect(fit, model, start, graduate=False)
