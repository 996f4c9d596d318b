"""The proof of models of MuJoCo: a case is a recording, a second one, the user's file, and the key."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Generator

from examples.blind_proof import draws
from examples.blind_proof.aims import INSEPARABLE_BELOW, Threshold
from examples.blind_proof.equations.oracle import ratio_to_oracle
from examples.blind_proof.key import Key, KeyEffect, KeyParameter, KeyRival
from examples.blind_proof.mujoco.elements import Element
from examples.blind_proof.mujoco.power import Power, power
from examples.blind_proof.mujoco.robots import ROBOTS, Robot
from examples.blind_proof.mujoco.stepping import SAMPLE, Array, Truth, fitted_numbers, stepped
from examples.blind_proof.proof import Case, Proof, Scenario
from mkc_torch.recording.recording import Recording

SAMPLES = 400

THRESHOLDS = (
    Threshold("empty_cases", 200, float("inf"), "Empty recordings, at least 200 at level 0.05"),
    Threshold("false_alarms", 0.0, 0.07, "at most 7 % false alarms"),
    Threshold("strong", 60, float("inf"), "z and z_sep at least 10, at least 60 recordings"),
    Threshold("named", 0.90, 1.0, "named right in at least 90 %"),
    Threshold("at_port", 0.90, 1.0, "at the right joint, actuator or body in at least 90 %"),
    Threshold("coverage", 0.85, 1.0, "90 % intervals cover the size in at least 85 %"),
    Threshold("second_ratio", 0.0, 1.15, "free run on a second recording at most 1.15 of the noise (median)"),
)

_SIZE = {"coulomb_friction": "friction", "input_lag": "lag", "input_delay": "delay", "constant_change": "change"}
"""Name of the size in a finding."""

_UNIT = {"input_lag": "s", "input_delay": "s"}


def mujoco_steps() -> Proof:
    """Return the proof with recordings of five robots, each compared with its user's file."""
    scenario = Scenario("mujoco", "five robots, stepped by MuJoCo", draw, THRESHOLDS, share=1 / 2)
    return Proof("mujoco", (scenario,), 200, ratio=ratio_to_oracle)


def draw(seed: int, index: int, hidden: bool = True, number: int = 0) -> Case:
    """Draw the case at an address. The same address gives the same case.

    Args:
        seed: seed of the proof.
        index: number of the case.
        hidden: hide an element.
        number: not used; the recording's name has the index.
    """

    def stream(what: str) -> Generator:
        return draws.generator(seed, index, "mujoco", what)

    name = draws.choose(stream("robot"), tuple(ROBOTS))
    return case_of(stream, f"{name}_{index:05d}", ROBOTS[name], empty=not hidden)


def case_of(stream: Callable[[str], Generator], name: str, robot: Robot, *, empty: bool = False) -> Case:
    """Draw a case of a robot.

    Args:
        stream: returns a random generator for each purpose.
        name: name of the recording.
        robot: the robot.
        empty: hide nothing.
    """
    g = stream("numbers")
    factors = {number: draws.log_uniform(g, 0.8, 1.25) for number in fitted_numbers(robot)}
    begin = tuple(0.05 * draws.normal(g, 2 * len(robot.joints)).numpy())
    truth = Truth(robot, factors=factors, begin=tuple(float(value) for value in begin))
    if not empty:
        g = stream("element")
        element = draws.choose(g, robot.elements)
        truth = replace(truth, element=element, size=draws.log_uniform(g, *element.sizes))
    noise, digit, share = _errors(stream("noise"), robot)
    deviations = np.sqrt(noise**2 + digit**2 / 12.0)
    controls = _controls(stream("controls"), robot)
    first, bad, _ = _recorded(stream, "", truth, controls, noise, digit, share)
    key = Key(
        name=name,
        kind="empty" if empty else "single",
        mode=robot.name,
        effects=(),
        noise={"deviation": dict(zip(robot.joints, deviations.tolist(), strict=True))},
        outlier_kind={"share": share},
        outliers=bad,
        second_outliers=(),
        decoys={},
        sensor=factors,
        field_strength=0.0,
        oracle_rms=0.0,
        columns=tuple(first),
        scenario="mujoco",
    )
    recording = Recording(first, name=name)
    if truth.element is None:
        return Case(recording, key, simulation=robot.xml)
    effect = _key_effect(truth.element, truth.size, power(truth, controls, deviations, share))
    later = _controls(stream("later controls"), robot)
    second, again, rms = _recorded(stream, "later ", truth, later, noise, digit, share)
    key = replace(key, effects=(effect,), second_outliers=again, oracle_rms=rms)
    return Case(recording, key, Recording(second, name=f"{name}_second"), robot.xml)


def _key_effect(element: Element, size: float, seen: Power) -> KeyEffect:
    rivals = [KeyRival(rival.effect, (), distance, rival.at) for rival, distance in seen.rivals]
    known = _SIZE.get(element.effect)
    parameters = () if known is None else (KeyParameter(known, size, _UNIT.get(element.effect, ""), scored=True),)
    return KeyEffect(
        effect=element.effect,
        form=element.form,
        drivers=(),
        withheld="",
        onset=None,
        size=size,
        parameters=parameters,
        z=seen.z,
        z_sep=seen.z_sep,
        rival=rivals[0] if rivals else None,
        inseparable=tuple(rival for rival in rivals if rival.z_sep < INSEPARABLE_BELOW),
        at=element.at,
    )


def _errors(g: Generator, robot: Robot) -> tuple[Array, Array, float]:
    """Draw the white noise and the resolution of each joint's encoder, and the share of outliers."""
    count = len(robot.joints)
    noise = np.array([draws.log_uniform(g, 3e-4, 2e-3) for _ in range(count)])
    digit = np.full(count, 2.0 * np.pi / 2.0 ** draws.whole(g, 12, 16))
    return noise, digit, draws.uniform(g, 0.01, 0.03)


def _controls(g: Generator, robot: Robot) -> Array:
    """Draw the commands (N, k): for each actuator three waves, and levels that are held for a while."""
    time = SAMPLE * np.arange(SAMPLES)
    columns = []
    for size in robot.commands.values():
        periods = [robot.slowest * draws.uniform(g, 0.8, 1.2) / part for part in (1.0, 2.3, 4.7)]
        phases = [draws.uniform(g, 0.0, 2.0 * np.pi) for _ in periods]
        waves = sum(
            share * np.sin(2.0 * np.pi * time / period + phase)
            for share, period, phase in zip((0.4, 0.3, 0.2), periods, phases, strict=True)
        )
        hold = round(robot.slowest / SAMPLE / 3.0)
        levels = np.repeat(draws.normal(g, SAMPLES // hold + 1).numpy(), hold)[:SAMPLES]
        columns.append(size * (waves + 0.3 * levels))
    return np.round(np.stack(columns, 1), 5)


def _recorded(
    stream: Callable[[str], Generator],
    when: str,
    truth: Truth,
    controls: Array,
    noise: Array,
    digit: Array,
    share: float,
) -> tuple[dict[str, torch.Tensor], tuple[int, ...], float]:
    """Return the columns of a recording, its outliers by number, and the noise's RMS in standard deviations.

    Outliers are numbered joint by joint.
    """
    true, g = stepped(truth, controls), stream(f"{when}errors")
    shown = digit * np.round((true + noise * draws.normal(g, *true.shape).numpy()) / digit)
    wrong = torch.rand(true.shape, generator=g, dtype=torch.float64).numpy() < share
    far = np.ptp(true, axis=0) * draws.normal(g, *true.shape).numpy()
    errors = (shown - true) / np.sqrt(noise**2 + digit**2 / 12.0)
    rms = float(np.sqrt(np.square(errors[~wrong]).mean()))
    shown = np.where(wrong, shown + far, shown)
    columns = {"time": SAMPLE * np.arange(SAMPLES)}
    columns |= dict(zip(truth.robot.commands, controls.T, strict=True))
    columns |= dict(zip(truth.robot.joints, shown.T, strict=True))
    tensors = {name: torch.from_numpy(np.round(values, 7)) for name, values in columns.items()}
    return tensors, tuple(np.flatnonzero(wrong.T).tolist()), rms
