"""Diagnosis: which physics a simulation leaves out of a recording, and how much the fit improves with it."""

from mkc_torch.diagnosis.diagnose import diagnose
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.plot.accessor import DiagnosisPlot
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.validation.check import check
from mkc_torch.diagnosis.validation.result import RecordingCheck

__all__ = ["DiagnosedModel", "Diagnosis", "DiagnosisPlot", "RecordingCheck", "Settings", "check", "diagnose"]
