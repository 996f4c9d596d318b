"""The error message for a simulation without a first fit."""

from __future__ import annotations

from mkc_torch.simulation.dynamics.other_starts import OtherStarts
from mkc_torch.simulation.protocol import PreparedSimulation


def no_first_fit(prepared: PreparedSimulation, others: OtherStarts | None = None) -> str:
    """Return sentences: what is wrong, what was tried and what to change.

    Args:
        prepared: the simulation.
        others: the further starts that were tried; None for a simulation without states.
    """
    where = f"{prepared.recording.name}: " if prepared.recording.name else ""
    outputs = ", ".join(f"`{name}`" for name in prepared.channels)
    if others is None:
        return (
            f"{where}no fit of {prepared.name} to {outputs} succeeds from the given parameter values: its output is "
            "too far from the recording, or not finite nearby. Give values nearer to the system's own, and check "
            "units and signs."
        )
    return " ".join(
        [
            f"{where}no fit of {prepared.name} to {outputs} was found.",
            *_lost(others),
            f"Tried: the given values, values with which the measured states obey the equations, {others.tried} starts "
            "between and around them (each parameter with the other sign, 0, and 3 to 30 times smaller or larger), "
            "and predictions over a few samples only.",
            f"Check the sign and the unit of {_what(others)} in `derivative`; or give a value nearer to the system's "
            "own, or limits, Parameter(value, lower=..., upper=...), within which the simulation stays finite.",
        ]
    )


def _lost(others: OtherStarts) -> list[str]:
    """Describe how the simulation diverges with the user's values."""
    if not others.output:
        return []
    if others.until <= 0.0:
        first = f"With the given values, the equations have no finite solution: `{others.output}` diverges at once."
    else:
        first = f"With the given values, `{others.output}` diverges within {others.until:.4g} s."
    if not others.parameter:
        return [f"{first} No change of a single parameter keeps it finite for longer."]
    lasts = "throughout" if others.lasts == float("inf") else f"for {others.lasts:.4g} s"
    return [first, f"With `{others.parameter}` = {others.value:.4g} it stays finite {lasts}."]


def _what(others: OtherStarts) -> str:
    return f"`{others.parameter}`" if others.parameter else "each term"
