"""Sentences on sizes that differ between recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.diagnosis.result import EffectParameter


def differing_sizes(parameters: Sequence[EffectParameter], recordings: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence for each parameter with a number for each recording; none for a common size.

    Args:
        parameters: of a finding.
        recordings: that each have a size of their own; empty for a common size.

    Example:
        >>> drag = EffectParameter("drag", (0.0067, 0.02), (0.0001, 0.0004), "1/m", ("a", "b"))
        >>> differing_sizes([drag], ["a", "b"])
        ('The drag differs between the recordings: 0.00670 ± 0.00010 1/m in a, 0.02000 ± 0.00040 1/m in b.',)
        >>> differing_sizes([drag], [])
        ()
    """
    if not recordings:
        return ()
    return tuple(_sentence(parameter, recordings[0]) for parameter in parameters if parameter.components)


def _sentence(parameter: EffectParameter, first: str) -> str:
    value, error = parameter.value, parameter.standard_error
    values = value if isinstance(value, tuple) else (value,)
    errors = error if isinstance(error, tuple) else (error,)
    sizes = []
    for number, (value, name) in enumerate(zip(values, parameter.components, strict=True)):
        error = errors[number] if number < len(errors) else None
        sizes.append(f"{_with_error(value, error)} {parameter.unit}".rstrip() + f" in {name}")
    text = f"The {parameter.name.replace('_', ' ')} differs between the recordings: {', '.join(sizes)}"
    if any(name.endswith(first) for name in parameter.components):
        return f"{text}."
    return f"{text}, relative to {first}, where the simulation's own parameters hold."


def _with_error(value: object, error: object) -> str:
    """Return a number with two digits of its standard error."""
    assert isinstance(value, float)
    if not isinstance(error, float) or not math.isfinite(error) or error <= 0.0:
        return f"{value:.4g}"
    decimals = 1 - math.floor(math.log10(error))
    if not 0 <= decimals <= 9:
        return f"{value:.4g} ± {error:.2g}"
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"
