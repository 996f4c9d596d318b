"""An effect of a model as an entry of ``model.json``."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.per_recording import is_relative


def term_entry(term: Term, gamma: Tensor) -> dict[str, object]:
    """Return an effect with its size, as JSON values.

    Args:
        term: the effect with its place and its drivers.
        gamma: its coefficients.
    """
    return {
        "effect": term.effect.id,
        "drivers": [
            {"column": column, "reference": float(reference), "unit": unit}
            for column, reference, unit in zip(*_columns(term), strict=True)
        ],
        "shape": dict(term.shape),
        **({"port": term.at} if term.at else {}),
        **({"first": True} if term.first else {}),
        **({"recordings": list(term.effect.recordings)} if term.effect.recordings else {}),
        **({"relative": True} if is_relative(term.effect) else {}),
        "parameters": gamma.tolist(),
        "equation": term.effect.equation,
    }


def _columns(term: Term) -> tuple[Sequence[str], Sequence[float], Sequence[str]]:
    if term.driver is None:
        return (), (), ()
    return term.driver.columns, term.driver.reference.tolist(), term.driver.units
