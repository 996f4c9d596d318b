"""Reports as self-contained HTML pages. Needs the ``cli`` extra."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkc_torch.report.calibration.page import Comparison, calibration_report, refusal_report
    from mkc_torch.report.check.page import check_report
    from mkc_torch.report.diagnosis.page import diagnosis_report

__all__ = ["Comparison", "calibration_report", "check_report", "diagnosis_report", "refusal_report"]

_HOMES = {
    "Comparison": "calibration.page",
    "calibration_report": "calibration.page",
    "check_report": "check.page",
    "diagnosis_report": "diagnosis.page",
    "refusal_report": "calibration.page",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        # importing templates and figures takes half a second; many commands need only the texts
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
