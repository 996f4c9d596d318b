"""Scenarios of the magnetometer: noise, drift, bursts, resting orientations, and unusable recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from examples.blind_proof import aims, draws
from examples.blind_proof.key import KeyDisturbance
from examples.blind_proof.magnetometer import hidden as physics
from examples.blind_proof.magnetometer.cases import (
    Contaminated,
    contaminate_scene,
    draw_scene,
    key_effect,
    key_of,
    recording_of,
    size_effects,
    total_of,
)
from examples.blind_proof.magnetometer.columns import Plan, draw_columns, draw_plan
from examples.blind_proof.magnetometer.hidden import Hidden
from examples.blind_proof.magnetometer.motion import DURATION, RATE, poses
from examples.blind_proof.magnetometer.noise import Noise, Outliers, bursts, draw_noise, draw_outliers, drifting
from examples.blind_proof.magnetometer.scene import Scene
from examples.blind_proof.proof import Case, Proof, Scenario

if TYPE_CHECKING:
    from jaxtyping import Float

OUTSIDE_SHARE = 0.25
"""Share of hidden effects that are outside the catalogue."""

UNRELATED, WRONG_SIGN, OTHER_GYRO, OTHER_ATTITUDE = (
    "unrelated field",
    "gyroscope of the wrong sign",
    "gyroscope of another recording",
    "attitude of another recording",
)

_COLOURED = ("ar1", "ar2", "ambient ar")
_VIEWS: Mapping[str, str] = MappingProxyType({WRONG_SIGN: "gyro", OTHER_GYRO: "gyro", OTHER_ATTITUDE: "attitude"})
_SIMULATION = """from mkc_torch.simulation import Magnetometer

sensor = Magnetometer(use="{view}")
"""
_SPREAD = 30.0
"""Standard deviation of a signal that is not a field, on each axis, µT."""


def magnetometer_scenarios(duration: float = DURATION) -> Proof:
    """Return six scenarios of a magnetometer, for recordings of a duration in s. Noise is white except in ``coloured``.

    Example:
        >>> [scenario.name for scenario in magnetometer_scenarios().scenarios]
        ['white', 'coloured', 'wander', 'bursts', 'orientations', 'useless']
    """

    def scenario(name: str, sentence: str, asked: tuple[aims.Threshold, ...], right: str) -> Scenario:
        return Scenario(name, sentence, partial(draw, name, duration), asked, right=right, wrong=aims.CLAIMED)

    useless = partial(draw_useless, duration)
    return Proof(
        "magnetometer_scenarios",
        (
            scenario("white", "white sensor noise", aims.WHITE, aims.QUIET),
            scenario("coloured", "sensor noise correlated from sample to sample", aims.ORDINARY, aims.NAMELESS),
            scenario("wander", "a drifting offset", aims.ORDINARY, aims.NAMELESS),
            scenario("bursts", "bursts of disturbance", aims.ORDINARY, aims.NAMELESS),
            scenario("orientations", "the sensor rests in one orientation after another", aims.WHITE, aims.QUIET),
            Scenario(
                "useless",
                "a recording that the magnetometer cannot explain",
                useless,
                aims.USELESS,
                hides=False,
                right="unfit",
                wrong="adequate",
            ),
        ),
        empty=60,
        totals=aims.TOTALS,
        settings={"duration_s": duration},
    )


def draw(scenario: str, duration: float, seed: int, index: int, hidden: bool, number: int) -> Case:
    """Draw the case at an address.

    Args:
        scenario: white, coloured, wander, bursts, orientations.
        duration: length of the recording in s.
        seed: seed of the proof.
        index: number of the case among those of its scenario, hidden or empty.
        hidden: hide physics. In every second such case the offset drifts, too.
        number: number in the recording's name; nothing else depends on it.
    """

    def stream(what: str) -> Generator:
        return draws.generator(seed, "worlds", "magnetometer", scenario, "hidden" if hidden else "empty", index, what)

    scene = _scene(stream, scenario, duration)
    count, name = len(scene.time), f"case_{number:05d}"
    noise, outliers = _noise(stream, scenario, count), draw_outliers(stream("outliers"))
    disturbance = None
    if index % 2 == 0 if hidden else scenario == "wander":
        noise, far = drifting(stream("wander"), noise, count)
        disturbance = KeyDisturbance("wander", "sensor", far * noise.sigma, "µT", far)
    burst, disturbed = torch.zeros_like(scene.field), torch.zeros(count, dtype=torch.bool)
    if scenario == "bursts":
        burst, disturbed = bursts(stream("bursts"), noise.sigma, count, scene.step)
        share = float(disturbed.double().mean())
        disturbance = disturbance or KeyDisturbance(
            "bursts", "sensor", float(burst.abs().max()), "µT", 0.0, {"share": share}
        )
        outliers = replace(outliers, share=min(outliers.share + share, 0.5))
    effects = [_effect(stream("effect"), scene)] if hidden else []
    needed = frozenset(effect.driver for effect in effects if effect.driver)
    plan = draw_plan(stream("plan"), needed, frozenset())
    columns = draw_columns(stream("columns"), plan, scene, noise)
    kind, total, found = "empty", burst, []
    if effects:
        kind = "single" if effects[0].effect in physics.CATALOGUE else "outside"
        found = size_effects(stream("size"), kind, effects, scene, noise, outliers, plan, columns)
        total = burst + total_of(effects, [size for size, _ in found], scene)
    contaminated = _contaminated(stream, scenario, scene, noise, outliers, total, disturbed)
    key = replace(
        key_of(name, kind, plan, scene, noise, outliers, contaminated, columns),
        scenario=scenario,
        index=index,
        disturbance=disturbance,
        effects=tuple(key_effect(e, size, power, plan) for e, (size, power) in zip(effects, found, strict=True)),
    )
    return Case(recording_of(name, scene, contaminated, columns), key)


def draw_useless(duration: float, seed: int, index: int, hidden: bool, number: int) -> Case:
    """Draw a recording without a field, or with the gyroscope or attitude of another recording."""

    def stream(what: str) -> Generator:
        return draws.generator(seed, "worlds", "magnetometer", "useless", index, what)

    kind, name = (UNRELATED, WRONG_SIGN, OTHER_GYRO, OTHER_ATTITUDE)[index % 4], f"case_{number:05d}"
    scene = draw_scene(stream("scene"), duration, RATE)
    other = draw_scene(stream("other scene"), duration, RATE)
    noise = _noise(stream, "useless", len(scene.time))
    outliers = draw_outliers(stream("outliers"))
    plan = replace(draw_plan(stream("plan"), frozenset(), frozenset()), mode=_VIEWS.get(kind, "norm"))
    contaminated = contaminate_scene(stream("errors"), scene, noise, outliers, torch.zeros_like(scene.field))
    seen = _replaced_columns(stream, kind, plan, scene, other, noise)
    if kind == UNRELATED:
        path = _SPREAD * draws.smooth(stream("path"), len(scene.time), 3, scene.step, 2.0)
        clean = scene.field @ scene.sensor.soft.mT
        contaminated = replace(contaminated, measured=contaminated.measured - clean + path)
    key = key_of(name, "useless", plan, scene, noise, outliers, contaminated, seen)
    simulation = _SIMULATION.format(view=_VIEWS[kind]) if kind in _VIEWS else ""
    key = replace(key, scenario="useless", index=index, useless=kind)
    return Case(recording_of(name, scene, contaminated, seen), key, simulation=simulation)


def _replaced_columns(
    stream: Callable[[str], Generator], kind: str, plan: Plan, scene: Scene, other: Scene, noise: Noise
) -> dict[str, Float[Tensor, " N"]]:
    """Return the columns; some are those of the other recording, or have the wrong sign."""
    columns = draw_columns(stream("columns"), plan, scene, noise)
    elsewhere = draw_columns(stream("other columns"), plan, other, noise)
    if kind == WRONG_SIGN:
        return {name: -values if name.startswith("gyro") else values for name, values in columns.items()}
    first = {OTHER_GYRO: "gyro", OTHER_ATTITUDE: "q"}.get(kind)
    return {name: elsewhere[name] if name.split("_")[0] == first else values for name, values in columns.items()}


def _scene(stream: Callable[[str], Generator], scenario: str, duration: float) -> Scene:
    scene = draw_scene(stream("scene"), duration, RATE)
    if scenario == "orientations":
        return replace(scene, motion=poses(stream("poses"), duration=duration, rate=RATE))
    return scene


def _noise(stream: Callable[[str], Generator], scenario: str, samples: int) -> Noise:
    """Draw white noise with a right attitude, or coloured noise in the scenario ``coloured``."""
    for again in range(1000):
        noise = draw_noise(stream(f"noise {again}"), samples, RATE)
        if scenario == "coloured" and noise.kind in _COLOURED:
            return noise
        if scenario != "coloured" and noise.kind == "white":
            return replace(noise, attitude=None)
    raise AssertionError("no noise of the required kind in a thousand draws")


def _effect(g: Generator, scene: Scene) -> Hidden:
    forms = physics.OUTSIDE if draws.happens(g, OUTSIDE_SHARE) else physics.CATALOGUE
    return forms[draws.choose(g, list(forms))](g, scene)


def _contaminated(
    stream: Callable[[str], Generator],
    scenario: str,
    scene: Scene,
    noise: Noise,
    outliers: Outliers,
    added: Float[Tensor, "N 3"],
    disturbed: Tensor,
) -> Contaminated:
    """Contaminate the measurement; disturbed samples count as outliers, too."""
    if scenario == "bursts":
        outliers = replace(outliers, share=max(outliers.share - float(disturbed.double().mean()), 0.0))
    contaminated = contaminate_scene(stream("errors"), scene, noise, outliers, added)
    return replace(contaminated, mask=contaminated.mask | disturbed)
