"""Optional steps of a diagnosis: an internal error in a step costs its result only, and becomes a warning."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple, TypeVar

from mkc_torch.nonlinear import NoFitError

T = TypeVar("T")


class _Warnings(NamedTuple):
    """The warnings of the running diagnosis, and the process that collects them."""

    process: int
    sentences: list[str]


_warnings: ContextVar[_Warnings | None] = ContextVar("warnings_of_steps", default=None)


@contextmanager
def optional_steps() -> Iterator[list[str]]:
    """Let the optional steps within the block fail; yields the list that receives a warning for each that did."""
    token = _warnings.set(_Warnings(os.getpid(), []))
    try:
        known = _warnings.get()
        assert known is not None
        yield known.sentences
    finally:
        _warnings.reset(token)


def optional(
    step: str, work: Callable[[], T], otherwise: Callable[[], T], possible: Callable[[], bool] = lambda: True
) -> T:
    """Return the result of a step, or after an internal error the result without it, with a warning.

    Only within :func:`optional_steps`; elsewhere the error is raised. Arguments are checked, and the simulation is
    fitted, before the first optional step: so no error here is meant for the user. A stop and an interrupt end the
    step as usual. In a forked copy the error is raised too: the work is then done again in the process that collects
    the warnings.

    Args:
        step: its name in the warning.
        work: the step.
        otherwise: returns the result without the step.
        possible: whether there is a result without the step; if not, the error is raised.

    Example:
        >>> with optional_steps() as warnings:
        ...     optional("counting", lambda: 1 // 0, lambda: 3)
        3
        >>> warnings[0]
        "The step 'counting' ended in an internal error (ZeroDivisionError: ...); the result is that before it. ..."
    """
    try:
        return work()
    except Exception as error:
        known = _warnings.get()
        if known is None or known.process != os.getpid() or not possible():
            raise
        known.sentences.append(failure(step, error))
    return otherwise()


def failure(step: str, error: Exception) -> str:
    """Return the warning on a step that ended in an internal error.

    Example:
        >>> failure("counting", RuntimeError("sizes differ")).partition(";")[0]
        "The step 'counting' ended in an internal error (RuntimeError: sizes differ)"
        >>> failure("counting", NoFitError("No fit is finite."))
        "The step 'counting' has no result: No fit is finite."
    """
    if isinstance(error, NoFitError):
        return f"The step '{step}' has no result: {_in_one_line(error)}"
    return (
        f"The step '{step}' ended in an internal error ({type(error).__name__}: {_in_one_line(error)}); the result "
        "is that before it. Please report this."
    )


def _in_one_line(error: Exception) -> str:
    return " ".join(str(error).split())
