"""What a quick look or a stopped search leaves unknown, as sentences of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from mkc_torch._parallel.deadline import Reason

__all__ = ["Stop", "notices"]

_QUICK = (
    "Quick look: no p-values, false-alarm rate not controlled. Leave out --quick (in Python quick=True) to have both."
)


@dataclass(frozen=True)
class Stop:
    """Why a diagnosis was stopped before its end, and what was not done.

    Attributes:
        reason: "time limit" or "interrupt".
        seconds: run time until the stop.
        not_done: the missing parts, as nouns.
    """

    reason: Reason
    seconds: float
    not_done: tuple[str, ...]

    def __str__(self) -> str:
        how = "by an interrupt " if self.reason == "interrupt" else ""
        left = "; ".join(self.not_done)
        return f"Stopped {how}after {self.seconds:.0f} s: the search was not finished; not done: {left}."


def notices(stop: Stop | None, *, quick: bool) -> tuple[str, ...]:
    """Return the sentences.

    Example:
        >>> notices(Stop("time limit", 60.2, ("the search for effects",)), quick=False)
        ('Stopped after 60 s: the search was not finished; not done: the search for effects.',)
    """
    return (*(() if stop is None else (str(stop),)), *((_QUICK,) if quick else ()))
