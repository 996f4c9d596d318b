"""Diagnose with the nominal models of the blind proof twice: in PyTorch, and as FMUs that are compiled here.

    python -m tests.benchmarks.fmu --recordings 60

Prints for each recording the first findings, the difference of the parameters, and the time on one core.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from examples.blind_proof.equations import cases, models
from mkc_torch import Diagnosis, diagnose
from mkc_torch.simulation import Dynamics, Parameter, Simulation, load_fmu
from tests.simulation.fmu.made import Model, make_fmu

SEED = 350
"""Seed of the recordings; no setting of the adapter was chosen with them."""

FIRST = 0
"""Index of the first recording."""

_OUTLET = "sqrt(Piecewise(({0}, {0} > 1e-4), (1e-4, True)))"
RATES: Mapping[str, Mapping[str, str]] = {
    "pendulum": {"angle": "speed", "speed": "gain*torque - stiffness*sin(angle) - damping*speed"},
    "cart_pole": {
        "position": "speed",
        "speed": "gain*force - drag*speed",
        "angle": "turn",
        "turn": "-((gain*force - drag*speed)*cos(angle) + 9.81*sin(angle))/length - damping*turn",
    },
    "tanks": {
        "level_1": f"gain_1*pump_1 - outlet_1*{_OUTLET.format('level_1')}",
        "level_2": f"gain_2*pump_2 - outlet_2*{_OUTLET.format('level_2')}",
    },
    "motor": {
        "angle": "speed",
        "speed": "torque*current - damping*speed",
        "current": "drive*voltage - resistance*current - back_emf*speed",
    },
    "projectile": {"distance": "speed", "height": "climb", "speed": "0.0", "climb": "-9.81"},
    "thermal": {
        "temperature_1": "gain_1*heater_1 - loss_1*(temperature_1 - room)",
        "temperature_2": "gain_2*heater_2 - loss_2*(temperature_2 - room)",
    },
}
"""The equations of ``examples.blind_proof.equations.models``, as texts."""

NOMINAL: Mapping[str, type[Dynamics]] = {
    "pendulum": models.Pendulum,
    "cart_pole": models.CartPole,
    "tanks": models.Tanks,
    "motor": models.Motor,
    "projectile": models.Projectile,
    "thermal": models.Thermal,
}


@dataclass(frozen=True)
class Pair:
    """A recording diagnosed twice: first findings, largest relative difference of a parameter, and seconds."""

    name: str
    effects: tuple[str, str]
    off: float
    seconds: tuple[float, float]

    @property
    def same(self) -> bool:
        return self.effects[0] == self.effects[1]


def as_fmu(system: str, folder: Path, version: int = 2, *, derivatives: bool = True) -> Path:
    """The nominal simulation of a system as an FMU."""
    kind = NOMINAL[system]
    known = {name: p if isinstance(p, Parameter) else Parameter(p) for name, p in kind.parameters.items()}
    bounds = {
        name: (p.value, *(None if abs(end) == float("inf") else end for end in (p.lower, p.upper)), p.unit)
        for name, p in known.items()
    }
    model = Model(kind.__name__, RATES[system], bounds, kind.inputs, units=dict(kind.units))
    return make_fmu(folder / f"{system}_{version}.fmu", model, version, derivatives=derivatives)


def pairs(count: int, version: int = 2, *, derivatives: bool = True, surrogates: int = 19) -> Iterator[Pair]:
    """Yield the first ``count`` recordings of the seed; recordings of a system without states are left out."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as place:
        fmus: dict[str, Simulation] = {}
        for index in range(FIRST, FIRST + count):
            case = cases.draw(SEED, index)
            system = case.key.mode
            if system not in RATES:  # a system without differential equations
                continue
            if system not in fmus:
                fmus[system] = load_fmu(as_fmu(system, Path(place), version, derivatives=derivatives))
            results, seconds = [], []
            for simulation in (NOMINAL[system](), fmus[system]):
                began = time.process_time()
                results.append(diagnose(simulation, case.recording, surrogates=surrogates, max_findings=1))
                seconds.append(time.process_time() - began)
            yield Pair(
                case.recording.name, _first_findings(results), _largest_difference(results), (seconds[0], seconds[1])
            )


def _first_findings(results: list[Diagnosis]) -> tuple[str, str]:
    first, second = (result.findings[0].effect if result.findings else "nothing" for result in results)
    return first, second


def _largest_difference(results: list[Diagnosis]) -> float:
    """Largest relative difference of the simulation's parameters; 0 without parameters."""
    first, second = (result.model.theta for result in results)
    if len(first) != len(second) or not len(first):
        return 0.0 if len(first) == len(second) else float("inf")
    return float(((first - second).abs() / first.abs().clamp(min=1e-12)).max())


def main() -> None:
    """Print a line for each recording, and the sums."""
    parser = argparse.ArgumentParser(description="Diagnoses of the same equations as torch and as FMU")
    parser.add_argument("--recordings", type=int, default=60)
    parser.add_argument("--version", type=int, choices=(2, 3), default=2, help="version of FMI")
    parser.add_argument("--differences", action="store_true", help="without directional derivatives")
    given = parser.parse_args()
    known: list[Pair] = []
    for pair in pairs(given.recordings, given.version, derivatives=not given.differences):
        known.append(pair)
        ratio = pair.seconds[1] / pair.seconds[0]
        print(
            f"{pair.name:18} {pair.effects[0]:26} {pair.effects[1]:26} {100 * pair.off:8.4f} % "
            f"{pair.seconds[0]:7.1f} s {pair.seconds[1]:7.1f} s {ratio:5.2f}",
            flush=True,
        )
    same = sum(pair.same for pair in known)
    close = sum(pair.off <= 0.01 for pair in known)
    torchs, fmus = (sum(pair.seconds[k] for pair in known) for k in (0, 1))
    print(
        f"{same} of {len(known)} with the same first finding; parameters within 1 % in {close}; "
        f"{torchs:.0f} s as torch, {fmus:.0f} s as FMU, {fmus / torchs:.2f} times"
    )


if __name__ == "__main__":
    main()
