"""Draws that thresholds of the verdict are set on: `python -m tests.thresholds.open_loop --per-hidden 4 --output DIR`.

Simulated recordings of a ship's turn, a circuit, a basin and a sled, with hidden physics, white noise of the sensor and
a lasting disturbance or slow error of the sensor. No other test or recording of the project has these systems. Each
recording is searched as `mkc diagnose` does, for models with one effect. Writes `DIR/draws.json` and prints the error
rates of the thresholds. For each model: whether its effect is right, its score, the ratio of its open-loop residual to
that of the simulation alone, and its gain by the residual's correlation beyond Schwarz's penalty. A run into the same
folder continues an interrupted run.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import fit_alone
from mkc_torch.diagnosis.model.shapes import candidates_of
from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain
from mkc_torch.diagnosis.score import basis_of
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter

Array = NDArray[np.float64]
Rate = Callable[[Array, float], Array]

NOTHING, THIN = "nothing", "drag in thinning air"
"""No effect; and quadratic drag whose size falls along the track, which no candidate is exactly."""

THINNING, LENGTH = 0.5, 100.0
"""Decay of the air's density over the length of the track in m."""

SAMPLES, FINE = 300, 6
"""Samples of a recording, and steps of the integration between two."""

SENSOR, SLOW = 0.01, 0.03
"""Standard deviations of white noise and of a slow error, as shares of the output's standard deviation."""

DISTURBANCE = 0.1
"""Standard deviation of a disturbance, as a share of that of the last state's rate."""


class Ship(Dynamics):
    """A ship's heading after its rudder, by Nomoto."""

    states, inputs, outputs = ("heading", "turn"), ("rudder",), ("heading",)
    units = MappingProxyType({"heading": "rad", "turn": "rad/s", "rudder": "rad"})
    parameters = MappingProxyType({"damping": Parameter(0.2, lower=0.0), "gain": Parameter(0.3, lower=0.0)})

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {"heading": x.turn, "turn": p.gain * u.rudder - p.damping * x.turn}


class Circuit(Dynamics):
    """A coil, a resistor and a capacitor in series; the charge is measured."""

    states, inputs, outputs = ("charge", "current"), ("source",), ("charge",)
    units = MappingProxyType({"charge": "C", "current": "A", "source": "V"})
    parameters = MappingProxyType({"stiffness": Parameter(3.0, lower=0.0), "resistance": Parameter(0.4, lower=0.0)})

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {"charge": x.current, "current": u.source - p.stiffness * x.charge - p.resistance * x.current}


class Basin(Dynamics):
    """A stirred basin with an inflow of salt."""

    states, inputs, outputs = ("salt",), ("inflow",), ("salt",)
    units = MappingProxyType({"salt": "kg", "inflow": "kg/s"})
    parameters = MappingProxyType({"outflow": Parameter(0.2, lower=0.0), "gain": Parameter(0.8, lower=0.0)})

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {"salt": p.gain * u.inflow - p.outflow * x.salt}


class Sled(Dynamics):
    """A sled on a level track with a propeller; its speed is measured."""

    states, inputs, outputs = ("speed",), ("thrust",), ("speed",)
    units = MappingProxyType({"speed": "m/s", "thrust": "N"})
    parameters = MappingProxyType({"gain": Parameter(0.8, lower=0.0)})

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {"speed": p.gain * u.thrust}


def _ship(kind: str, size: float) -> Rate:
    def rate(x: Array, u: float) -> Array:
        extra = {"quadratic_drag": 0.8 * size * x[1] * abs(x[1]), "coulomb_friction": 0.05 * size * np.tanh(200 * x[1])}
        return np.array([x[1], 0.4 * u - 0.25 * x[1] - extra.get(kind, 0.0)])

    return rate


def _circuit(kind: str, size: float) -> Rate:
    def rate(x: Array, u: float) -> Array:
        extra = {"cubic_stiffness": 4.0 * size * x[0] ** 3, "coulomb_friction": 0.3 * size * np.tanh(100 * x[1])}
        return np.array([x[1], u - 4.0 * x[0] - 0.5 * x[1] - extra.get(kind, 0.0)])

    return rate


def _basin(kind: str, size: float) -> Rate:
    def rate(x: Array, u: float) -> Array:
        store = 0.25 * size * (x[1] - x[0]) if kind == "hidden_lag" else 0.0
        loss = 0.1 * size * max(x[0], 0.0) ** 1.6 if kind == "power_law" else 0.0
        return np.array([u - 0.3 * x[0] + store - loss, 0.1 * (x[0] - x[1])])

    return rate


def _sled(kind: str, size: float) -> Rate:
    exponent = {"linear_drag": 1.0, "power_law": 1.5}.get(kind, 2.0)

    def rate(x: Array, u: float) -> Array:
        air = math.exp(-THINNING * x[1] / LENGTH) if kind == THIN else 1.0
        loss = 0.4 * size * air * math.copysign(abs(x[0]) ** exponent, x[0]) if kind != NOTHING else 0.0
        return np.array([u - loss, x[0]])

    return rate


SYSTEMS: Mapping[str, tuple[Any, Callable[[str, float], Rate], int, tuple[str, ...]]] = MappingProxyType(
    {
        "ship": (Ship, _ship, 2, ("quadratic_drag", "coulomb_friction")),
        "circuit": (Circuit, _circuit, 2, ("cubic_stiffness", "coulomb_friction")),
        "basin": (Basin, _basin, 2, ("hidden_lag", "power_law")),
        "sled": (Sled, _sled, 2, ("quadratic_drag", "power_law", "linear_drag", THIN)),
    }
)
"""Simulation, true rates, number of true states, and effects to hide."""

SAME = MappingProxyType({"hidden_lag": ("hidden_lag",), THIN: ("quadratic_drag", "power_law")})
"""Candidates that are right for a hidden effect, where these are others than the effect and the general power law."""


def drawn(name: str, hidden: str, seed: int) -> Recording:
    """Draw a recording of a system of :data:`SYSTEMS`; the same seed gives the same recording."""
    _, equations, states, _ = SYSTEMS[name]
    random = np.random.default_rng([seed, *name.encode(), *hidden.encode()])
    step = 0.2 if name != "circuit" else 0.08
    clock = step * np.arange(SAMPLES)
    waves = (0.15, 0.4, 0.9, 2.1)
    force = sum(random.normal() * np.sin(w * clock + random.uniform(0.0, 2.0 * np.pi)) for w in waves)
    force = force + (2.0 if name in ("basin", "sled") else 0.0)
    rate = equations(hidden, float(np.exp(random.uniform(np.log(0.3), np.log(1.5)))))
    share = float(random.choice([0.02, 0.1, 0.3]))
    disturbed = bool(random.integers(2))
    disturbance = (
        DISTURBANCE * float(np.std(force)) * _slow(random, share) * (0.4 if name == "ship" else 1.0) * disturbed
    )
    course, x = [], np.zeros(states)
    for k in range(SAMPLES):
        course.append(x[0])
        for part in range(FINE):
            u = force[k] + (force[min(k + 1, SAMPLES - 1)] - force[k]) * (part + 0.5) / FINE
            h, kick = step / FINE, np.zeros(states)
            kick[1 if name in ("ship", "circuit") else 0] = disturbance[k]
            x = x + h * (rate(x + 0.5 * h * (rate(x, u) + kick), u) + kick)
    output = np.array(course)
    size = float(output.std())
    output = (
        output + SENSOR * size * random.standard_normal(SAMPLES) + (not disturbed) * SLOW * size * _slow(random, share)
    )
    simulation = SYSTEMS[name][0]
    columns = {"time": clock, simulation.inputs[0]: force, simulation.outputs[0]: output}
    return Recording({key: torch.from_numpy(values) for key, values in columns.items()}, name=name)


def _slow(random: np.random.Generator, share: float) -> Array:
    """A stationary course of variance 1 that is correlated for a share of the recording."""
    keep = math.exp(-1.0 / (share * SAMPLES))
    series = random.standard_normal(SAMPLES)
    series[1:] *= math.sqrt(1.0 - keep**2)
    for k in range(1, SAMPLES):
        series[k] += keep * series[k - 1]
    return series


def search_statistics(name: str, hidden: str, seed: int) -> dict[str, Any]:
    """Fit the models with one effect, as the search does, and return their statistics, highest score first."""
    right = SAME.get(hidden, (hidden, "power_law"))
    settings, simulation = Settings(), SYSTEMS[name][0]()
    begin = time.process_time()
    baseline = fit_alone(simulation.prepare(drawn(name, hidden, seed)), {}, settings.noise)
    start = baseline.fit if baseline.free is None else baseline.free
    terms = candidates_of(simulation, start.model.prepared.open_loop(), CATALOGUE, settings.drivers)[1]
    basis = basis_of(baseline.fit, len({term.key for term in terms}), {}, settings)
    beam = BeamSearch(terms, basis, settings, {}, most_terms=1)
    best = beam.run(start)
    claimed = [term.effect.id for term in best.fit.model.terms]
    models = sorted(beam.models.values(), key=lambda model: -model.value)
    return {
        "system": name,
        "hidden": hidden,
        "seed": seed,
        "claimed": claimed[0] if claimed else NOTHING,
        "models": [_described(model, start, right) for model in models if model.fit.model.terms],
        "cpu_seconds": round(time.process_time() - begin, 1),
    }


def _described(model: Candidate, alone: FittedModel, right: Sequence[str]) -> dict[str, Any]:
    """Return the statistics of a model with one effect."""
    fit = model.fit
    effect = fit.model.terms[-1].effect
    price = 0.5 * (fit.model.sizes[-1] + len(effect.fitted_shape)) * math.log(len(fit.residual))
    return {
        "effect": effect.id,
        "right": effect.id in right,
        "score": model.value,
        "ratio": math.exp(float((size_of(fit.residual) / size_of(alone.residual)).log().mean())),
        "gain": agreed_innovation_gain(alone.residual, fit.residual) - price,
    }


def rates(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Lines with the error rates of each threshold at several values; each counts recordings."""
    empty = [row["models"] for row in rows if row["hidden"] == NOTHING and row["models"]]
    there = [row for row in rows if row["hidden"] != NOTHING]
    leading = [row["models"] for row in there if row["models"]]
    known = [[c for c in row["models"] if c["right"]] for row in there]
    known = [fits for fits in known if fits]
    for limit in (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98):
        chance = sum(any(c["ratio"] < limit for c in fits) for fits in empty)
        missed = sum(all(c["ratio"] >= limit for c in fits) for fits in known)
        best = [fits[0]["ratio"] >= limit for fits in leading if fits[0]["right"]]
        wrong = [fits[0]["ratio"] >= limit for fits in leading if not fits[0]["right"]]
        yield (
            f"ratio {limit}: by chance below {chance}/{len(empty)}; hidden effect not below {missed}/{len(known)}, "
            f"as most likely candidate {sum(best)}/{len(best)}; wrong most likely candidate not below "
            f"{sum(wrong)}/{len(wrong)}"
        )
    for nats in (-4.5, 0.0, 2.0, 4.5, 8.0):
        chance = sum(any(c["gain"] > nats for c in fits) for fits in empty)
        missed = sum(all(c["gain"] <= nats for c in fits) for fits in known)
        yield f"gain {nats}: by chance above {chance}/{len(empty)}, hidden effect not above {missed}/{len(known)}"
    named = sum(row["claimed"] in {c["effect"] for c in row["models"] if c["right"]} for row in there)
    false = sum(row["claimed"] != NOTHING for row in rows if row["hidden"] == NOTHING)
    yield f"highest score: hidden effect {named}/{len(there)}; an effect by chance {false}/{len(rows) - len(there)}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Search the draws and print the error rates. Always returns 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder of draws.json")
    parser.add_argument("--per-hidden", type=int, default=4, help="recordings of each system and hidden effect")
    parser.add_argument("--systems", nargs="+", choices=list(SYSTEMS), default=list(SYSTEMS), help="systems to draw")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    file = options.output / "draws.json"
    rows = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else []
    done = {(row["system"], row["hidden"], row["seed"]) for row in rows}
    for seed in range(options.per_hidden):
        for name in options.systems:
            for hidden in (*SYSTEMS[name][3], NOTHING):
                if (name, hidden, seed) not in done:
                    rows.append(search_statistics(name, hidden, seed))
                    file.write_text(json.dumps(rows, indent=1), encoding="utf-8")
                    print(rows[-1], file=sys.stderr)
    print("\n".join(rates(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
