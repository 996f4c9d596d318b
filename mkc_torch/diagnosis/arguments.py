"""What :func:`mkc_torch.diagnose` is given, checked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_other_type, told
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
    raise TypeError(f"Expected argument `simulation` to be a Simulation but got {told(simulation)}; {mend}.")


def checked_effects(effects: object) -> tuple[Effect, ...]:
    if isinstance(effects, str) or not isinstance(effects, Iterable):
        raise TypeError(
            f"Expected argument `effects` to be a sequence of Effects but got {told(effects)}; it is a tuple such as "
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
    raise TypeError(f"Expected argument `effects` to hold Effects but got {told(effect)}; {mend}.")


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


def checked_noise(noise: Mapping[str, float] | None, outputs: Sequence[str]) -> dict[str, float]:
    """Sizes of outputs' white noise.

    Raises:
        ValueError: a name that is no output, or a size that is not positive and finite.
    """
    found = {}
    for name, size in (noise or {}).items():
        if name not in outputs:
            raise ValueError(f"Expected `noise` to name outputs ({', '.join(outputs)}) but got `{name}`.")
        found[name] = checked_number(f"noise of {name}", size, advice="it is a standard deviation")
    return found


def checked_between(between: Mapping[str, str] | None, prepared: object) -> dict[str, str]:
    """What inputs do between samples.

    Raises:
        ValueError: a name that is no input, or something that no input does.
    """
    inputs: Mapping[str, str] = getattr(prepared, "between", {})
    for name, how in (between or {}).items():
        if name not in inputs:
            named = f"inputs ({', '.join(inputs)})" if inputs else "inputs, of which this simulation has none,"
            raise ValueError(f"Expected `between` to name {named} but got `{name}`.")
        if how not in ("held", "linear", "smooth"):
            raise ValueError(f'Expected `between` of {name} to be "held", "linear" or "smooth" but got {how!r}.')
    return dict(between or {})
