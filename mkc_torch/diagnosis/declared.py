"""Properties of a recording that the user declares: white noise of outputs, and holds of inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mkc_torch._support.arguments import checked_number, format_value

BETWEEN = ("held", "linear", "smooth")
"""Input holds between two samples."""


def checked_noise(noise: object, outputs: Sequence[str]) -> dict[str, float]:
    """Return the declared standard deviations of the sensors' white noise, by output.

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


def checked_input_hold(input_hold: object, inputs: Sequence[str]) -> dict[str, str]:
    """Return the declared input holds of differential equations, by input.

    Example:
        >>> checked_input_hold({"torque": "held"}, ["torque"])
        {'torque': 'held'}
    """
    found = {}
    for name, hold in _of_known(
        "input_hold", input_hold, inputs, "inputs in the equations", '{"torque": "held"}'
    ).items():
        if not isinstance(hold, str) or hold not in BETWEEN:
            raise ValueError(
                f"Expected argument `input_hold` of `{name}` to be one of {', '.join(BETWEEN)} but got {hold!r}."
            )
        found[name] = hold
    return found


def _of_known(argument: str, given: object, names: Sequence[str], what: str, example: str) -> dict[str, object]:
    """Return a mapping whose names the simulation knows; None gives an empty mapping."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise TypeError(f"Expected argument `{argument}` to be a dict such as {example} but got {format_value(given)}.")
    for name in given:
        if name not in names:
            known = f"they are {', '.join(f'`{known_name}`' for known_name in names)}" if names else "it has none"
            raise ValueError(
                f"Expected argument `{argument}` to name {what} of this simulation but got `{name}`; {known}."
            )
    return dict(given)
