"""The proof of differential equations: a case is a recording, a second one, and the key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Generator, Tensor

from examples.blind_proof import draws
from examples.blind_proof.aims import INSEPARABLE_BELOW, Threshold
from examples.blind_proof.equations.errors import OUTLIERS, Errors, Whitening, contaminate, draw_errors, sample
from examples.blind_proof.equations.hidden import System
from examples.blind_proof.equations.integrate import Course, SystemScene, simulate
from examples.blind_proof.equations.oracle import (
    EffectPower,
    can_be_named,
    draw_size,
    names,
    oracle_rms,
    power,
    ratio_to_oracle,
)
from examples.blind_proof.equations.plant import Array, HiddenTerm, Plant, RunSet
from examples.blind_proof.equations.simulations import class_of, right_source
from examples.blind_proof.equations.systems import SYSTEMS
from examples.blind_proof.key import Key, KeyEffect, KeyRival
from examples.blind_proof.magnetometer.columns import plain
from examples.blind_proof.proof import Case, Proof, Scenario
from mkc_torch.recording.recording import Recording

OUTSIDE_SHARE = 0.08
"""Share of cases with an effect outside the catalogue."""

_DIGITS = 7
"""Significant digits of inputs and outputs in a recording."""


THRESHOLDS = (
    Threshold("empty_cases", 150, float("inf"), "Empty recordings, at least 150 at level 0.05"),
    Threshold("false_alarms", 0.0, 0.08, "at most 8 % false alarms"),
    Threshold("strong", 50, float("inf"), "z and z_sep at least 10, at least 50 recordings"),
    Threshold("named", 0.90, 1.0, "named right in at least 90 %"),
    Threshold("at_port", 0.90, 1.0, "at the right state, input or output in at least 90 %"),
    Threshold("second_ratio", 0.0, 1.1, "free run on a second recording at most 1.1 of the oracle's error (median)"),
)


@dataclass(frozen=True)
class MeasuredColumns:
    """Columns of a recording, its sensor errors (m, T, R), and the mask of outliers."""

    columns: dict[str, Tensor]
    errors: Array
    bad: np.ndarray


def equations() -> Proof:
    """Return the proof with recordings of seven systems, each compared with its nominal simulation."""
    sentence = "six systems of differential equations and a servo"
    scenario = Scenario("equations", sentence, draw, THRESHOLDS, share=2 / 3)
    return Proof("equations", (scenario,), 150, ratio=ratio_to_oracle)


def draw(seed: int, index: int, hidden: bool = True, number: int = 0) -> Case:
    """Draw the case at an address. The same address gives the same case.

    Args:
        seed: seed of the proof.
        index: number of the case.
        hidden: hide physics.
        number: not used; the recording's name has the index.
    """

    def stream(what: str) -> Generator:
        return draws.generator(seed, index, "dynamics", what)

    system = draws.choose(stream("system"), tuple(SYSTEMS))
    return case_of(stream, f"{system}_{index:05d}", SYSTEMS[system], empty=not hidden)


def case_of(
    stream: Callable[[str], Generator],
    name: str,
    system: System,
    *,
    empty: bool = False,
    outside_share: float = OUTSIDE_SHARE,
) -> Case:
    """Draw a case of a system.

    Args:
        stream: returns a random generator for each purpose.
        name: name of the recording.
        system: the system.
        empty: hide no physics.
        outside_share: share of effects outside the catalogue.
    """
    setting = system.draw(stream("setting"))
    plant = setting.plant
    scene = SystemScene(plant, setting.trial, simulate(plant, setting.trial))
    errors = draw_errors(stream("noise"), scene.course.outputs)
    simulation = right_source(class_of(plant.name))
    if empty:
        measured = measured_by(stream, "", plant, setting.trial, scene.course, errors)
        key = key_of(name, "empty", plant, errors, measured)
        return Case(Recording(measured.columns, name=name), key, simulation=simulation)
    kind, hidden, size, seen = hide(stream, system, scene, errors, outside_share)
    measured = measured_by(stream, "", plant, setting.trial, simulate(plant, setting.trial, hidden, size), errors)
    later = simulate(plant, setting.later, hidden, size)
    again = measured_by(stream, "later ", plant, setting.later, later, errors)
    key = replace(
        key_of(name, kind, plant, errors, measured),
        effects=(key_effect(hidden, size, seen),),
        second_outliers=_numbers(again.bad),
        oracle_rms=oracle_rms(plant, setting.later, hidden, size, errors, again.errors, ~again.bad),
    )
    second = Recording(again.columns, name=f"{name}_second")
    return Case(Recording(measured.columns, name=name), key, second, simulation)


def hide(
    stream: Callable[[str], Generator],
    system: System,
    scene: SystemScene,
    errors: Whitening,
    outside_share: float = OUTSIDE_SHARE,
) -> tuple[str, HiddenTerm, float, EffectPower]:
    """Return the kind of an effect, the effect, its size, and its detectability at that size."""
    g = stream("effect")
    outside = draws.happens(g, outside_share)
    hidden = draws.choose(g, system.outside if outside else system.inside)(g, scene)
    known = frozenset() if outside else names(scene)
    while not (outside or can_be_named(hidden, known)):
        hidden = draws.choose(g, system.inside)(g, scene)
    size = draw_size(stream("size"), hidden, scene, errors, outside=outside)
    seen = power(scene.plant, scene.trial, hidden, size, errors)
    return "outside" if outside else "single", hidden, size, seen


def measured_by(
    stream: Callable[[str], Generator], when: str, plant: Plant, trial: RunSet, course: Course, errors: Errors
) -> MeasuredColumns:
    """Return the recording: its runs one after the other, inputs, outputs with errors, and decoy columns."""
    samples, runs = trial.samples, trial.runs
    noise = sample(stream(f"{when}errors"), errors, samples, runs)
    bad, mask = contaminate(stream(f"{when}outliers"), errors, samples, runs)
    seen = course.outputs + noise + bad
    time = torch.arange(samples, dtype=torch.float64).mul(trial.step).round(decimals=6)
    columns = {"time": time.repeat(runs)}
    if runs > 1:
        columns["experiment"] = torch.arange(runs, dtype=torch.float64).repeat_interleave(samples)
    columns |= {name: _column(values) for name, values in zip(plant.inputs, trial.inputs, strict=True)}
    columns |= {name: _column(values) for name, values in zip(plant.outputs, seen, strict=True)}
    return MeasuredColumns(columns | _decoys(stream(f"{when}decoys"), plant, columns), noise + bad, mask)


def _decoys(g: Generator, plant: Plant, columns: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Draw decoys: a trend of the temperature and, with an input, a noisy copy of it."""
    count = len(columns["time"])
    found = {"temperature": 22.0 + plain(g, "trend", torch.arange(count, dtype=torch.float64))}
    if plant.inputs:
        sent = columns[plant.inputs[0]]
        found["aux_1"] = draws.uniform(g, 0.5, 2.0) * (sent + 0.2 * sent.std() * draws.normal(g, count))
    return {name: values.round(decimals=4) for name, values in found.items()}


def _column(values: Array) -> Tensor:
    """Return (T, R) as one column, run after run, rounded to a number of digits."""
    flat = values.T.ravel()
    unit = 10.0 ** (np.floor(np.log10(np.abs(flat).max() + 1e-300)) - _DIGITS + 1)
    return torch.from_numpy(np.round(flat / unit) * unit)


def _numbers(mask: np.ndarray) -> tuple[int, ...]:
    """Return the numbers of the outliers in (m, T, R), counted output by output and run by run."""
    return tuple(np.flatnonzero(mask.transpose(0, 2, 1)).tolist())


def key_of(name: str, kind: str, plant: Plant, errors: Errors, measured: MeasuredColumns) -> Key:
    return Key(
        name=name,
        kind=kind,
        mode=plant.name,
        effects=(),
        noise=errors.numbers(plant.outputs),
        outlier_kind={"share": OUTLIERS},
        outliers=_numbers(measured.bad),
        second_outliers=(),
        decoys={},
        sensor=plant.parameters,
        field_strength=0.0,
        oracle_rms=0.0,
        columns=tuple(measured.columns),
        scenario="equations",
    )


def key_effect(hidden: HiddenTerm, size: float, seen: EffectPower) -> KeyEffect:
    rivals = [KeyRival(rival.effect, (), rival.z_sep, rival.at) for rival in (*seen.rivals, *seen.larger)]
    return KeyEffect(
        effect=hidden.effect,
        form=hidden.form,
        drivers=(),
        withheld="",
        onset=None,
        size=size,
        parameters=(),
        z=seen.z,
        z_sep=seen.z_sep,
        rival=rivals[0] if rivals else None,
        inseparable=tuple(rival for rival in rivals if rival.z_sep < INSEPARABLE_BELOW),
        at=hidden.at,
    )
