"""The proof of the magnetometer: a case is a recording, a second one, and the key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Generator, Tensor

from examples.blind_proof import draws
from examples.blind_proof.aims import INSEPARABLE_BELOW, THRESHOLDS
from examples.blind_proof.key import Key, KeyEffect, KeyParameter, KeyRival
from examples.blind_proof.magnetometer import hidden as physics
from examples.blind_proof.magnetometer.baselines import stepwise_bic
from examples.blind_proof.magnetometer.columns import Plan, draw_columns, draw_plan, rounded
from examples.blind_proof.magnetometer.families import (
    POSITION,
    EffectFamily,
    column_family,
    cubic_family,
    families,
    gradient_family,
    step_family,
    traceless,
)
from examples.blind_proof.magnetometer.hidden import Hidden
from examples.blind_proof.magnetometer.motion import DURATION, RATE, tumble, within
from examples.blind_proof.magnetometer.noise import (
    Noise,
    Outliers,
    ambient_errors,
    axis_errors,
    contaminate,
    draw_noise,
    draw_outliers,
)
from examples.blind_proof.magnetometer.power import Metric, Power, Question, powers, ratio_to_oracle, second_residual
from examples.blind_proof.magnetometer.scene import Scene, draw_current, draw_field, draw_sensor, draw_temperature
from examples.blind_proof.proof import Case, Proof, Scenario
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

KINDS = ("single", "double", "outside")
KIND_SHARES = (0.86, 0.07, 0.07)
WITHHELD_SHARE = 0.12
"""Share of the effects of temperature and current whose driver is not recorded."""

STRONG_SHARE = 0.7
"""Share of the single effects whose size is drawn by z_sep; the others are drawn by z."""

STRONG_Z_SEP = (10.5, 100.0)
FREE_Z = (3.0, 60.0)
DOUBLE_Z_SEP = (12.0, 80.0)
OUTSIDE_Z = (10.0, 60.0)
MOST_Z = 300.0
"""Limit of the size of an effect; a larger effect would be obvious."""

MOST_MISSED = 3.0
"""Largest z of the residual of the linear form for which its best coefficients are scored as true values.

The residual is orthogonal to the form and does not shift the estimate, but only with the same weights.
"""

PAUSE = 10.0
"""Seconds between the first recording and the second."""

_TINY = 1e-12


@dataclass(frozen=True)
class Contaminated:
    """A measurement with its errors: those of the length in µT, and the mask of outliers."""

    measured: Float[Tensor, "N 3"]
    errors: Float[Tensor, "N 3"]
    mask: Float[Tensor, " N"]


def magnetometer(duration: float = DURATION) -> Proof:
    """Return the proof with recordings of a magnetometer of a duration in s."""
    scenario = Scenario("magnetometer", "a magnetometer that is turned", partial(draw, duration), THRESHOLDS, share=0.6)
    return Proof(
        "magnetometer",
        (scenario,),
        400,
        ratio=_ratio,
        baselines={"Least squares, stepwise BIC": _stepwise},
        settings={"duration_s": duration},
    )


def _ratio(corrected: Mapping[str, Tensor], second: Recording, key: Key) -> float:
    return ratio_to_oracle(corrected, key)


def _stepwise(path: Path) -> Mapping[str, Any] | None:
    return stepwise_bic(Recording.read(path))


def draw(duration: float, seed: int, index: int, hidden: bool = True, number: int = 0) -> Case:
    """Draw the case at an address. The same address gives the same case.

    An empty case is drawn in the same way, with the same columns, and an effect of size 0.

    Args:
        duration: length of the recording in s.
        seed: seed of the proof.
        index: number of the case.
        hidden: hide physics.
        number: not used; the recording's name has the index.
    """

    def stream(what: str) -> Generator:
        return draws.generator(seed, index, what)

    scene = draw_scene(stream("scene"), duration)
    kind, effects = draw_effects(stream("effect"), scene)
    can_be_withheld = [effect for effect in effects if effect.effect in ("temperature_offset", "current_field")]
    withheld = frozenset(e.driver for e in can_be_withheld if draws.happens(stream("withheld"), WITHHELD_SHARE))
    needed = frozenset(effect.driver for effect in effects if effect.driver) - withheld
    noise, outliers = draw_noise(stream("noise"), len(scene.time), RATE), draw_outliers(stream("outliers"))
    plan = draw_plan(stream("plan"), needed, withheld)
    columns = draw_columns(stream("columns"), plan, scene, noise)
    name = f"case_{index:05d}"
    if not hidden:
        contaminated = contaminate_scene(stream("errors"), scene, noise, outliers, torch.zeros_like(scene.field))
        key = key_of(name, "empty", plan, scene, noise, outliers, contaminated, columns)
        return Case(recording_of(name, scene, contaminated, columns), key)
    found = size_effects(stream("size"), kind, effects, scene, noise, outliers, plan, columns)
    sizes = [size for size, _ in found]
    contaminated = contaminate_scene(stream("errors"), scene, noise, outliers, total_of(effects, sizes, scene))
    later = later_scene(stream("later"), scene)
    later_columns = draw_columns(stream("later columns"), plan, later, noise)
    again = contaminate_scene(stream("later errors"), later, noise, outliers, total_of(effects, sizes, later))
    traces = [[effect.trace(at) for effect in effects] for at in (scene, later)]
    rms = second_residual(
        (Metric(scene, noise, False), Metric(later, noise, False)),
        traces,
        (contaminated.errors, again.errors),
        (~contaminated.mask, ~again.mask),
    )
    key = key_of(name, kind, plan, scene, noise, outliers, contaminated, columns)
    key = replace(
        key,
        effects=tuple(
            key_effect(effect, size, power, plan) for effect, (size, power) in zip(effects, found, strict=True)
        ),
        second_outliers=_numbers(again.mask),
        oracle_rms=rms,
    )
    second = recording_of(f"{name}_second", later, again, later_columns)
    return Case(recording_of(name, scene, contaminated, columns), key, second)


def draw_scene(g: Generator, duration: float = DURATION, rate: float = RATE) -> Scene:
    """Draw a motion, a sensor and its surroundings."""
    motion = tumble(g, duration=duration, rate=rate)
    return Scene(motion, draw_sensor(g), draw_field(g), draw_temperature(g, motion.time), draw_current(g, motion.time))


def later_scene(g: Generator, scene: Scene) -> Scene:
    """Draw a later scene of the same sensor at the same place with another motion; drivers keep their range."""
    time = scene.time
    length, rate = len(time) * scene.step, 1.0 / scene.step
    motion = tumble(g, duration=length, rate=rate, start=float(time[-1]) + PAUSE)
    temperature = _into_range(draw_temperature(g, motion.time), scene.temperature)
    current = _into_range(draw_current(g, motion.time), scene.current)
    return replace(scene, motion=within(motion, scene.motion), temperature=temperature, current=current, settled=True)


def draw_effects(g: Generator, scene: Scene) -> tuple[str, list[Hidden]]:
    """Draw the kind of case and its effects, without sizes."""
    kind = draws.choose(g, KINDS, KIND_SHARES)
    inside, outside = list(physics.CATALOGUE), list(physics.OUTSIDE)
    if kind == "outside":
        return kind, [physics.OUTSIDE[draws.choose(g, outside)](g, scene)]
    first = draws.choose(g, inside)
    names = [first]
    if kind == "double":
        names.append(draws.choose(g, [name for name in inside if name != first]))
    return kind, [physics.CATALOGUE[name](g, scene) for name in names]


def size_effects(
    g: Generator,
    kind: str,
    effects: Sequence[Hidden],
    scene: Scene,
    noise: Noise,
    outliers: Outliers,
    plan: Plan,
    columns: Mapping[str, Float[Tensor, " N"]],
) -> list[tuple[float, Power]]:
    """Return the size of each effect, for a drawn z or z_sep within plausible limits, and its power."""
    vector = plan.mode == "attitude"
    known = families(scene, columns, vector=vector)
    questions = [_question(effect, scene, plan, columns, known, vector=vector) for effect in effects]
    found = []
    for effect, power in zip(effects, powers(Metric(scene, noise, vector), questions, outliers.share), strict=True):
        trace = effect.trace(scene)
        reach = float(torch.linalg.vector_norm(trace - trace.mean(0), dim=-1).max())
        size = min(_wanted(g, kind, power), effect.most / max(reach, _TINY), MOST_Z / max(power.z, _TINY))
        found.append((size, power.scaled(size)))
    return found


def _wanted(g: Generator, kind: str, power: Power) -> float:
    if kind == "outside":
        return draws.log_uniform(g, *OUTSIDE_Z) / max(power.z, _TINY)
    if kind == "double":
        return draws.log_uniform(g, *DOUBLE_Z_SEP) / max(power.z_sep, _TINY)
    if draws.happens(g, STRONG_SHARE):
        return draws.log_uniform(g, *STRONG_Z_SEP) / max(power.z_sep, _TINY)
    return draws.log_uniform(g, *FREE_Z) / max(power.z, _TINY)


def _question(
    effect: Hidden,
    scene: Scene,
    plan: Plan,
    columns: Mapping[str, Float[Tensor, " N"]],
    known: Sequence[EffectFamily],
    *,
    vector: bool,
) -> Question:
    drivers = _drivers(effect, plan)
    unseen = effect.driver != "" and not drivers
    right = {(effect.effect, drivers)}
    if unseen:
        # without its driver, only the time course of the effect can be named
        right |= {("offset_drift", ()), ("hard_iron_step", ())}
    rivals = [family for family in known if (family.effect, family.drivers) not in right]
    own = None if unseen else _own_family(effect, scene, columns, vector=vector)
    return Question(effect.trace(scene), rivals, own)


def _own_family(
    effect: Hidden, scene: Scene, columns: Mapping[str, Float[Tensor, " N"]], *, vector: bool
) -> EffectFamily | None:
    """Return the linear form of the effect with the true onset and the recorded driver."""
    if effect.effect == "hard_iron_step" and effect.onset is not None:
        return step_family(scene.time, effect.onset)
    if effect.effect in ("temperature_offset", "current_field"):
        return column_family(effect.driver, columns[effect.driver])
    if effect.effect == "cubic_nonlinearity":
        return cubic_family(scene)
    if effect.effect == "field_gradient":
        return gradient_family(scene, torch.stack([columns[name] for name in POSITION], -1), vector=vector)
    return None


def contaminate_scene(
    g: Generator, scene: Scene, noise: Noise, outliers: Outliers, effect: Float[Tensor, "N 3"]
) -> Contaminated:
    """Return the measurement of a scene with an effect, noise and outliers, µT."""
    count = len(scene.time)
    errors = axis_errors(g, noise, count) + ambient_errors(g, noise, count)[:, None] * scene.along
    direction = torch.nn.functional.normalize(scene.field, dim=-1)
    bad, mask = contaminate(g, outliers, noise.sigma, direction)
    clean = scene.field @ scene.sensor.soft.mT + scene.sensor.hard
    return Contaminated(clean + effect + errors + bad, errors, mask)


def total_of(effects: Sequence[Hidden], sizes: Sequence[float], scene: Scene) -> Float[Tensor, "N 3"]:
    """Return the sum of the effects in the measurement, µT."""
    total = torch.zeros_like(scene.field)
    for effect, size in zip(effects, sizes, strict=True):
        total = total + size * effect.trace(scene)
    return total


def _into_range(values: Tensor, like: Tensor) -> Tensor:
    share = (values - values.min()) / (values.max() - values.min()).clamp(min=1e-12)
    return like.min() + (like.max() - like.min()) * share


def _drivers(effect: Hidden, plan: Plan) -> tuple[str, ...]:
    if effect.driver not in plan.present:
        return ()
    return POSITION if effect.driver == "position" else (effect.driver,)


def recording_of(name: str, scene: Scene, contaminated: Contaminated, columns: Mapping[str, Tensor]) -> Recording:
    axes = zip(("mag_x", "mag_y", "mag_z"), contaminated.measured.unbind(-1), strict=True)
    return Recording({"time": scene.time.round(decimals=6), **rounded(dict(axes)), **columns}, name=name)


def _numbers(mask: Tensor) -> tuple[int, ...]:
    return tuple(mask.nonzero().ravel().tolist())


def key_of(
    name: str,
    kind: str,
    plan: Plan,
    scene: Scene,
    noise: Noise,
    outliers: Outliers,
    contaminated: Contaminated,
    columns: Mapping[str, Tensor],
) -> Key:
    return Key(
        name=name,
        kind=kind,
        mode=plan.mode,
        effects=(),
        noise=noise.numbers(),
        outlier_kind=asdict(outliers),
        outliers=_numbers(contaminated.mask),
        second_outliers=(),
        decoys={name: decoy.kind for name, decoy in plan.decoys.items()},
        sensor={"soft": scene.sensor.soft.tolist(), "hard": scene.sensor.hard.tolist()},
        field_strength=float(torch.linalg.vector_norm(scene.field_world)),
        oracle_rms=0.0,
        columns=tuple(columns),
        scenario="magnetometer",
    )


def key_effect(effect: Hidden, size: float, power: Power, plan: Plan) -> KeyEffect:
    drivers = _drivers(effect, plan)
    rivals = [KeyRival(rival.effect, rival.drivers, rival.z_sep) for rival in power.rivals]
    return KeyEffect(
        effect=effect.effect,
        form=effect.form,
        drivers=drivers,
        withheld=effect.driver if effect.driver and not drivers else "",
        onset=effect.onset,
        size=size,
        parameters=_key_parameters(effect, power),
        z=power.z,
        z_sep=power.z_sep,
        rival=rivals[0] if rivals else None,
        inseparable=tuple(rival for rival in rivals if rival.z_sep < INSEPARABLE_BELOW),
    )


_PARAMETERS: Mapping[str, tuple[str, str]] = {
    "hard_iron_step": ("offset_change", "µT"),
    "temperature_offset": ("temperature_coefficient", "µT/K"),
    "current_field": ("current_coefficient", "µT/A"),
    "field_gradient": ("gradient", "µT/m"),
    "cubic_nonlinearity": ("cubic_coefficient", "1/µT²"),
}


def _key_parameters(effect: Hidden, power: Power) -> tuple[KeyParameter, ...]:
    if effect.effect not in _PARAMETERS or not power.coefficients:
        return ()
    name, unit = _PARAMETERS[effect.effect]
    coefficients = torch.tensor(power.coefficients, dtype=torch.float64)
    if len(coefficients) == 5:
        coefficients = torch.einsum("k,kij->ij", coefficients, traceless())
    scored = power.missed < MOST_MISSED
    return (KeyParameter(name, coefficients.tolist(), unit, scored),)
