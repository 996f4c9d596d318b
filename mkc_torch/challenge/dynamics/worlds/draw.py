"""A case of one world of differential equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from torch import Generator

from mkc_torch.challenge import draws
from mkc_torch.challenge.dynamics import cart_pole, motor, pendulum, projectile, tanks, thermal
from mkc_torch.challenge.dynamics.errors import Errors, Whitening, draw_errors
from mkc_torch.challenge.dynamics.generator import SYSTEMS, hide, key_effect, key_of, measured_by
from mkc_torch.challenge.dynamics.integrate import Course, simulate
from mkc_torch.challenge.dynamics.plant import Array, Plant, Setting, Trial
from mkc_torch.challenge.dynamics.scene import Scene
from mkc_torch.challenge.dynamics.subject import simulation_class
from mkc_torch.challenge.dynamics.worlds.follows import best_share
from mkc_torch.challenge.dynamics.worlds.noise import Pushed, PushedErrors, draw_push
from mkc_torch.challenge.dynamics.worlds.pushes import KINDS
from mkc_torch.challenge.dynamics.worlds.simulations import far_starts, right_source, wrong_source
from mkc_torch.challenge.dynamics.worlds.wrong import OTHER, UNRELATED, WRONG_SIGN, right, wrong
from mkc_torch.challenge.world import KeyPush, WorldCase, WorldKey
from mkc_torch.recording.recording import Recording

OUTSIDE_SHARE = 0.25
"""Share of the hidden effects that no diagnosis with the catalogue can name."""

CORRELATION = (0.3, 0.9)
"""Of coloured noise from sample to sample."""

RUNS = (3, 5)
"""How many runs the world of several runs has."""

MOST_FOLLOWED = 0.4
"""Share of an output's variation that the best fit of a useless simulation may explain, where it explains least."""

_TRIED = 60

_TRIALS: Mapping[str, Callable[[Generator, Plant, int, int], Trial]] = MappingProxyType(
    {
        "pendulum": pendulum.trial,
        "cart_pole": cart_pole.trial,
        "tanks": lambda g, plant, runs, samples: tanks.trial(g, runs, samples),  # noqa: ARG005 - one signature
        "motor": lambda g, plant, runs, samples: motor.trial(g, runs, samples),  # noqa: ARG005
        "projectile": lambda g, plant, runs, samples: projectile.trial(g, runs),  # noqa: ARG005
        "thermal": lambda g, plant, runs, samples: thermal.trial(g, runs, samples),  # noqa: ARG005
    }
)


def draw(world: str, seed: int, index: int, hidden: bool, number: int) -> WorldCase:
    """The case at that address.

    Args:
        world: a key of ``pushes.KINDS``, or white, coloured, held, far_starts, runs.
        seed: of the proof.
        index: of the case among those of its world, hidden or empty.
        hidden: hide something; in every second case of those a push acts too.
        number: in the recording's name, which alone depends on it.
    """

    def stream(what: str) -> Generator:
        return draws.generator(seed, "worlds", "dynamics", world, "hidden" if hidden else "empty", index, what)

    system, setting = _setting(stream, world)
    plant, trial = setting.plant, _trial(stream, world, system, setting)
    scene = Scene(plant, trial, simulate(plant, trial))
    errors = _errors(stream, world, scene.course.outputs)
    push = _push(stream, world, index, hidden, scene, errors)
    rates = None if push is None else push.rates
    name, simulation = f"{system}_{number:05d}", _simulation(stream, world, system)
    if not hidden:
        course = scene.course if rates is None else simulate(plant, trial, push=rates)
        return _case(stream, world, index, name, scene, course, errors, push, simulation)
    weighing: Whitening = errors if push is None else PushedErrors(scene, errors, push)
    kind, effect, size, seen = hide(stream, SYSTEMS[system], scene, weighing, OUTSIDE_SHARE)
    course = simulate(plant, trial, effect, size, rates)
    case = _case(stream, world, index, name, scene, course, errors, push, simulation)
    key = replace(case.key.key, kind=kind, effects=(key_effect(effect, size, seen),))
    return replace(case, key=replace(case.key, key=key))


def draw_useless(seed: int, index: int, hidden: bool, number: int) -> WorldCase:  # noqa: ARG001 - nothing to hide
    """A recording and a simulation that cannot follow it: a wrong sign, another system, or an unrelated output.

    What is drawn is drawn again until the best of many fits explains too little of an output to be of any use.
    """
    for again in range(_TRIED):

        def stream(what: str, again: int = again) -> Generator:
            return draws.generator(seed, "worlds", "dynamics", "useless", index, again, what)

        system, setting = _setting(stream, "useless")
        plant, trial = setting.plant, setting.trial
        scene = Scene(plant, trial, simulate(plant, trial))
        # the first draw decides of which kind the case is, so that each kind has its share
        kind = (WRONG_SIGN, OTHER, UNRELATED)[index % 3]
        course = scene.course
        if kind == UNRELATED:
            course = replace(course, outputs=_unrelated(stream("unrelated"), system, plant, trial))
        guess = right(plant) if kind == UNRELATED else wrong(plant, kind)
        follows = best_share(stream("fit"), guess, trial, course.outputs)
        if follows > MOST_FOLLOWED:
            continue
        errors = _errors(stream, "useless", course.outputs)
        name = _class_of(system)
        simulation = right_source(name) if kind == UNRELATED else wrong_source(name, kind)
        case = _case(stream, "useless", index, f"{system}_{number:05d}", scene, course, errors, None, simulation)
        key = replace(case.key.key, kind="useless")
        return replace(case, key=replace(case.key, key=key, useless=kind, follows=follows))
    raise RuntimeError(f"No useless case of seed {seed}, index {index} in {_TRIED} draws; loosen MOST_FOLLOWED.")


def _setting(stream: Callable[[str], Generator], world: str) -> tuple[str, Setting]:
    """A system and its runs; a throw has neither inputs to hold nor parameters to start far from."""
    without = {"projectile"} if world in ("held", "far_starts") else set()
    system = draws.choose(stream("system"), [name for name in SYSTEMS if name not in without])
    return system, SYSTEMS[system].draw(stream("setting"))


def _trial(stream: Callable[[str], Generator], world: str, system: str, setting: Setting) -> Trial:
    if world == "runs":
        g = stream("runs")
        runs = draws.whole(g, *RUNS)
        samples = setting.trial.samples * setting.trial.runs // runs
        return _TRIALS[system](g, setting.plant, runs, samples)
    return replace(setting.trial, held=world == "held")


def _errors(stream: Callable[[str], Generator], world: str, outputs: Array) -> Errors:
    correlation = draws.uniform(stream("colour"), *CORRELATION) if world == "coloured" else 0.0
    return replace(draw_errors(stream("noise"), outputs), correlation=correlation)


def _push(
    stream: Callable[[str], Generator], world: str, index: int, hidden: bool, scene: Scene, errors: Errors
) -> Pushed | None:
    """In worlds that have one; where something is hidden, in every second case of any world."""
    if not (index % 2 == 0 if hidden else world in KINDS):
        return None
    g = stream("push")
    return draw_push(g, world if world in KINDS else draws.choose(g, tuple(KINDS)), scene, errors)


def _unrelated(g: Generator, system: str, plant: Plant, trial: Trial) -> Array:
    """Outputs of other runs; of a throw, which has no inputs to belong to, paths that no throw takes."""
    if not plant.inputs:
        reach = np.array([draws.uniform(g, 2.0, 10.0) for _ in plant.outputs])
        length = (trial.samples - 1) * trial.step
        paths = [
            draws.smooth(g, trial.samples, len(plant.outputs), trial.step, draws.uniform(g, 0.15, 0.4) * length)
            for _ in range(trial.runs)
        ]
        return np.stack([path.numpy().T * reach[:, None] for path in paths], -1)
    return simulate(plant, _TRIALS[system](g, plant, trial.runs, trial.samples)).outputs


def _simulation(stream: Callable[[str], Generator], world: str, system: str) -> str:
    return right_source(_class_of(system), far_starts(stream("starts")) if world == "far_starts" else None)


def _class_of(system: str) -> str:
    return simulation_class(Path(f"{system}_0.csv"))


def _case(
    stream: Callable[[str], Generator],
    world: str,
    index: int,
    name: str,
    scene: Scene,
    course: Course,
    errors: Errors,
    push: Pushed | None,
    simulation: str,
) -> WorldCase:
    measured = measured_by(stream, "", scene.plant, scene.trial, course, errors)
    key = key_of(name, "empty", scene.plant, errors, measured)
    told = None if push is None else _key_push(push)
    return WorldCase(Recording(measured.columns, name=name), simulation, WorldKey(world, index, key, told))


def _key_push(push: Pushed) -> KeyPush:
    words = {**push.words, "over noise, true parameters": push.free_over_noise}
    return KeyPush(push.kind, push.state, push.size, push.unit, push.over_noise, words)
