"""The page of several recordings that were diagnosed or calibrated one by one: their results next to one another."""

from mkc_torch.report.fleet.calibrations import fleet_of_calibrations
from mkc_torch.report.fleet.content import Fleet, fleet_of
from mkc_torch.report.fleet.page import fleet_report

__all__ = ["Fleet", "fleet_of", "fleet_of_calibrations", "fleet_report"]
