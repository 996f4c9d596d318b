"""The page of several recordings that were diagnosed one by one: their findings next to one another."""

from mkc_torch.report.fleet.content import Fleet, fleet_of
from mkc_torch.report.fleet.page import fleet_report

__all__ = ["Fleet", "fleet_of", "fleet_report"]
