"""What :func:`mkc_torch.diagnose` is given, checked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from mkc_torch._support.arguments import checked_number, checked_whole, format_value, refuse_other_type
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects.base import Effect
from mkc_torch.recording.recording import Recording


def refuse_no_simulation(simulation: object) -> None:
    if not isinstance(simulation, type) and all(hasattr(simulation, name) for name in ("columns", "prepare")):
        return
    mend = "pass one, such as Magnetometer()"
    if isinstance(simulation, type):
        mend = f"make one, {simulation.__name__}()"
    elif isinstance(simulation, Recording):
        mend = "it comes first, diagnose(simulation, recording)"
    elif isinstance(simulation, str):
        mend += f", or name it on the command line, mkc diagnose REC.csv --simulation {simulation} --output DIR"
    raise TypeError(f"Expected argument `simulation` to be a Simulation but got {format_value(simulation)}; {mend}.")


def checked_effects(effects: object) -> tuple[Effect, ...]:
    if isinstance(effects, str) or not isinstance(effects, Iterable):
        raise TypeError(
            f"Expected argument `effects` to be a sequence of Effects but got {format_value(effects)}; it is a tuple such as "
            "mkc_torch.effects.CATALOGUE, which holds all, and () for none."
        )
    # an iterator would be empty when it is asked again
    checked = tuple(effects)
    for effect in checked:
        _refuse_no_effect(effect)
    return checked


def _refuse_no_effect(effect: object) -> None:
    roles: object = effect.roles if isinstance(effect, Effect) else ()
    if isinstance(effect, type):
        mend = f"make one, {effect.__name__}()"
    elif isinstance(effect, str):
        mend = f"mkc_torch.effects.CATALOGUE holds them, [e for e in CATALOGUE if e.id == {effect!r}]"
    elif not isinstance(effect, Effect):
        mend = "derive it from mkc_torch.effects.Effect, which has defaults for the rest"
    elif not effect.id:
        mend = "give it an `id`, its name in diagnosis.json"
    elif isinstance(roles, str):
        mend = f"its roles are names, ({roles!r},)"
    else:
        return
    raise TypeError(f"Expected argument `effects` to hold Effects but got {format_value(effect)}; {mend}.")


def refuse_no_settings(settings: object) -> None:
    advice = (
        "make one, Settings(), or change one, dataclasses.replace(Settings(), naming=NamingSettings(separable=8.0))"
    )
    refuse_other_type("settings", settings, Settings, "Settings", advice)


def check_numbers(level: float, surrogates: int, max_findings: int, seed: int) -> None:
    checked_number("level", level, 0.0, 1.0, advice="0.05 is usual")
    checked_whole("surrogates", surrogates, 0, "99 is usual")
    checked_whole("max_findings", max_findings, 0, "3 is usual")
    checked_whole("seed", seed)
    if surrogates < math.ceil(1.0 / level - 1.0 - 1e-9):
        raise ValueError(
            f"Expected argument `surrogates` to be at least {math.ceil(1.0 / level - 1.0 - 1e-9)} at level {level}, "
            f"for no p-value can be smaller than 1 / (surrogates + 1), but got {surrogates}."
        )


def check_limits(quick: object, time_limit: object) -> None:
    """Refuse a quick look that is no bool, and a time limit that is no number above 0."""
    refuse_other_type("quick", quick, bool, "bool", "True for a first look without p-values")
    if time_limit is not None:
        checked_number("time_limit", time_limit, 0.0, advice="seconds, such as 60; None is for no limit")


BETWEEN = ("held", "linear", "smooth")
"""What an input can do between two samples."""


def checked_noise(noise: object, outputs: Sequence[str]) -> dict[str, float]:
    """Declared sizes of the sensors' white noise, by output.

    Example:
        >>> checked_noise({"angle": 0.005}, ["angle", "rate"])
        {'angle': 0.005}
        >>> checked_noise({"x": 0.005}, ["angle"])
        Traceback (most recent call last):
        ValueError: Expected argument `noise` to name outputs of this simulation but got `x`; they are `angle`.
    """
    return {
        name: checked_number(f"noise[{name!r}]", size, advice="the standard deviation of that sensor's white noise")
        for name, size in _of_known("noise", noise, outputs, "outputs", '{"angle": 0.005}').items()
    }


def checked_between(between: object, inputs: Sequence[str]) -> dict[str, str]:
    """What inputs of differential equations are declared to do between two samples.

    Example:
        >>> checked_between({"torque": "held"}, ["torque"])
        {'torque': 'held'}
    """
    found = {}
    for name, told_as in _of_known("between", between, inputs, "inputs in the equations", '{"torque": "held"}').items():
        if not isinstance(told_as, str) or told_as not in BETWEEN:
            raise ValueError(
                f"Expected argument `input_hold` to say one of {', '.join(BETWEEN)} of `{name}` but got {told_as!r}."
            )
        found[name] = told_as
    return found


def _of_known(argument: str, given: object, names: Sequence[str], what: str, example: str) -> dict[str, object]:
    """A mapping from names that the simulation has; None is an empty one."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise TypeError(f"Expected argument `{argument}` to be a dict such as {example} but got {format_value(given)}.")
    for name in given:
        if name not in names:
            known = f"they are {', '.join(f'`{one}`' for one in names)}" if names else "it has none"
            raise ValueError(
                f"Expected argument `{argument}` to name {what} of this simulation but got `{name}`; {known}."
            )
    return dict(given)
