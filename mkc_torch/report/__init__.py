"""Reports a user reads: one HTML page each, pictures within, nothing loaded from elsewhere. Needs the ``cli`` extra."""

from mkc_torch.report.calibration import Comparison, calibration_report, refusal_report

__all__ = ["Comparison", "calibration_report", "refusal_report"]
