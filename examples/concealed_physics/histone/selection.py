"""Search for the best sets of effects by a criterion: forward, backward, and best first with swaps.

Forward selection and backward elimination end in local optima if effects can replace each other. A search that
continues from every model close to the best by the criterion (Burnham & Anderson 2002, 2.6: a difference of 2) passes
through them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from calibration import Calibration, Fit, Selection

EFFECT_COUNT = 32
CLOSE = 2.0
"""Models within this AICc of the best are as good; the search continues from all of them."""


NOISE = 1e-9
"""Smallest decrease of AICc that counts as a gain."""


@dataclass(frozen=True)
class Found:
    """Result of a search.

    Attributes:
        stepwise: end of forward and backward steps alone.
        best: the best model.
        good: all models found within :data:`CLOSE` of the best, best first.
        fits: models that were fitted.
        searched: models around which the search went on.
    """

    stepwise: Fit
    best: Selection
    good: dict[Selection, Fit]
    fits: int
    searched: int


def neighbours(selection: Selection, *, swaps: bool) -> Iterable[Selection]:
    """Return the sets with an effect added, removed, or swapped."""
    others = [number for number in range(EFFECT_COUNT) if number not in selection]
    yield from (selection | {new} for new in others)
    yield from (selection - {old} for old in selection)
    if swaps:
        yield from ((selection - {old}) | {new} for old in selection for new in others)


class Search:
    """A search that caches the fits of this start.

    Args:
        calibration: fits models.
        start: set of effects to begin with.
    """

    def __init__(self, calibration: Calibration, start: Selection) -> None:
        self.calibration, self.start = calibration, start
        self.fits = calibration.fitted([start])

    def step(self, forward: bool, backward: bool) -> Selection:
        """Add or remove the effect with the largest gain of the criterion, until there is no gain."""
        here = self.start
        while True:
            near = [
                selected
                for selected in neighbours(here, swaps=False)
                if (forward and len(selected) > len(here)) or (backward and len(selected) < len(here))
            ]
            self._fit(near, here)
            best = min(near, key=self._aicc, default=here)
            if self._aicc(best) >= self._aicc(here) - NOISE:
                return here
            here = best

    def best_first(self) -> Found:
        """Take steps, then search around the best unsearched model, while it is within 2 of the best."""
        stepwise = self.step(forward=True, backward=True)
        best, searched = stepwise, set[Selection]()
        while True:
            limit = self._aicc(best) + CLOSE
            waiting = [selected for selected, fit in self.fits.items() if fit.aicc < limit and selected not in searched]
            if not waiting:
                break
            here = min(waiting, key=self._aicc)
            searched.add(here)
            near = [
                selected for selected in neighbours(here, swaps=True) if self.calibration.bound(len(selected)) < limit
            ]
            self._fit(near, here)
            best = min((best, *near), key=self._aicc)
        good = {selected: fit for selected, fit in self.fits.items() if fit.aicc < self._aicc(best) + CLOSE}
        ordered = dict(sorted(good.items(), key=lambda item: item[1].aicc))
        return Found(self.fits[stepwise], best, ordered, len(self.fits), len(searched))

    def _fit(self, selections: Iterable[Selection], here: Selection) -> None:
        new = dict.fromkeys(selected for selected in selections if selected not in self.fits)
        self.fits |= self.calibration.fitted(new, self.fits[here])

    def _aicc(self, selection: Selection) -> float:
        return self.fits[selection].aicc
