"""Search for the best sets of effects by a criterion: forward, backward, and best first with swaps.

Forward selection and backward elimination end in local optima where effects can stand in for each other. A search that
goes on from every model that the criterion hardly tells from the best one (Burnham & Anderson 2002, 2.6: a difference
of 2) walks through them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from calibration import Calibration, Fit, Selection

EFFECT_COUNT = 32
CLOSE = 2.0
"""AICc above the best within which models are as good: all of them are searched around."""


NOISE = 1e-9
"""Of AICc: less is no gain."""


@dataclass(frozen=True)
class Found:
    """What a search ended with.

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
    """Sets with one effect more, with one less, and with one exchanged for another."""
    others = [number for number in range(EFFECT_COUNT) if number not in selection]
    yield from (selection | {new} for new in others)
    yield from (selection - {old} for old in selection)
    if swaps:
        yield from ((selection - {old}) | {new} for old in selection for new in others)


class Search:
    """A search that remembers the fits of this start.

    Args:
        calibration: which fits models.
        start: set of effects to begin with.
    """

    def __init__(self, calibration: Calibration, start: Selection) -> None:
        self.calibration, self.start = calibration, start
        self.fits = calibration.fitted([start])

    def step(self, forward: bool, backward: bool) -> Selection:
        """The end of steps that add or remove the one effect by which the criterion gains most."""
        here = self.start
        while True:
            near = [
                one
                for one in neighbours(here, swaps=False)
                if (forward and len(one) > len(here)) or (backward and len(one) < len(here))
            ]
            self._fit(near, here)
            best = min(near, key=self._aicc, default=here)
            if self._aicc(best) >= self._aicc(here) - NOISE:
                return here
            here = best

    def best_first(self) -> Found:
        """Steps, then on from the best model not yet searched around, while one is within 2 of the best of all."""
        stepwise = self.step(forward=True, backward=True)
        best, searched = stepwise, set[Selection]()
        while True:
            limit = self._aicc(best) + CLOSE
            waiting = [one for one, fit in self.fits.items() if fit.aicc < limit and one not in searched]
            if not waiting:
                break
            here = min(waiting, key=self._aicc)
            searched.add(here)
            near = [one for one in neighbours(here, swaps=True) if self.calibration.bound(len(one)) < limit]
            self._fit(near, here)
            best = min((best, *near), key=self._aicc)
        good = {one: fit for one, fit in self.fits.items() if fit.aicc < self._aicc(best) + CLOSE}
        ordered = dict(sorted(good.items(), key=lambda item: item[1].aicc))
        return Found(self.fits[stepwise], best, ordered, len(self.fits), len(searched))

    def _fit(self, selections: Iterable[Selection], here: Selection) -> None:
        new = dict.fromkeys(one for one in selections if one not in self.fits)
        self.fits |= self.calibration.fitted(new, self.fits[here])

    def _aicc(self, selection: Selection) -> float:
        return self.fits[selection].aicc
