"""The page of a check as self-contained HTML."""

from __future__ import annotations

from markupsafe import Markup

from mkc_torch.diagnosis.validation.result import RecordingCheck
from mkc_torch.report.check import picture, sentences
from mkc_torch.report.rendering import render


def check_report(check: RecordingCheck) -> str:
    """Return the page of a check: the verdict, the residuals of each output, and the overlay.

    Args:
        check: of :func:`mkc_torch.diagnosis.check`.

    Returns:
        HTML with inline figures.

    Example:
        >>> import torch
        >>> from mkc_torch import Recording, check, diagnose
        >>> from mkc_torch.simulation import Static
        >>> def bench(seed):
        ...     g, time = torch.Generator().manual_seed(seed), torch.arange(100) / 10.0
        ...     heat = torch.sin(time)
        ...     return Recording({"time": time, "heat": heat, "volt": heat + 0.01 * torch.randn(100, generator=g)})
        >>> line = Static(torch.nn.Linear(1, 1), inputs=("heat",), outputs=("volt",))
        >>> model = diagnose(line, bench(0), effects=(), surrogates=19).model
        >>> check_report(check(model, bench(1))).startswith("<!doctype html>")
        True
    """
    return render("check.html.j2", c=check, s=sentences, picture=Markup(picture.overlay(check)))
