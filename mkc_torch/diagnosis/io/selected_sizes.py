"""The size of an effect that differs between recordings, selected for a recording that the model was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.per_recording import PerRecording

if TYPE_CHECKING:
    from jaxtyping import Float


def recordings_of(terms: Sequence[Term]) -> tuple[str, ...]:
    """Return the names of the recordings between which a size differs; empty if all sizes are common."""
    return next((term.effect.recordings for term in terms if term.effect.recordings), ())


def selected(
    terms: Sequence[Term], gammas: Sequence[Float[Tensor, " q"]], name: str
) -> tuple[list[Term], list[Float[Tensor, " q"]]]:
    """Return effects and their γ with the sizes of one recording.

    Args:
        terms, gammas: the effects with their γ.
        name: of the recording.

    Raises:
        ValueError: no size differs between recordings, or the recording is not one of them.
    """
    known = recordings_of(terms)
    if not known:
        raise ValueError(
            f"Expected no recording whose sizes apply but got {name!r}: all sizes of this model are common to its "
            "recordings. Leave it out (`--sizes-of`)."
        )
    if name not in known:
        raise ValueError(
            f"Expected one of the diagnosed recordings, {' or '.join(map(repr, known))}, but got {name!r}; give the "
            "recording whose sizes apply (`--sizes-of`)."
        )
    found, sizes = [], []
    for term, gamma in zip(terms, gammas, strict=True):
        own = term.effect
        found.append(replace(term, effect=own.effect) if isinstance(own, PerRecording) else term)
        sizes.append(own.gamma_of(gamma, name) if isinstance(own, PerRecording) else gamma)
    return found, sizes


def without_runs(terms: Sequence[Term]) -> list[Term]:
    """Return effects without the assignment of runs to recordings, which holds for those of the fit only."""
    return [
        replace(term, effect=PerRecording(term.effect.effect, term.effect.recordings, relative=term.effect.from_first))
        if isinstance(term.effect, PerRecording)
        else term
        for term in terms
    ]


def refuse_unselected(terms: Sequence[Term]) -> None:
    """Raise if a size differs between the diagnosed recordings, and none is selected.

    Raises:
        ValueError: a size is not selected; the message lists the choices.
    """
    open_ = [term for term in terms if isinstance(term.effect, PerRecording) and term.effect.of_run is None]
    if not open_:
        return
    names = open_[0].effect.recordings
    effects = " and ".join(dict.fromkeys(term.effect.id for term in open_))
    raise ValueError(
        f"the size of {effects} differs between the diagnosed recordings {', '.join(names)}, and none of them is known "
        f"to hold for this recording: select one with `--sizes-of {names[0]}` (in Python "
        f"`model.with_sizes_of({names[0]!r})`)."
    )
