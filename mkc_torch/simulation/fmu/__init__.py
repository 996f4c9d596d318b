"""Simulations exported as FMUs (Functional Mock-up Units, FMI 2.0 and 3.0, fmi-standard.org)."""

from mkc_torch.simulation.fmu.cosimulation import Simulated
from mkc_torch.simulation.fmu.description import FmuError
from mkc_torch.simulation.fmu.equations import FmuDynamics, fmu_class, is_of_an_fmu, load_fmu

__all__ = ["FmuDynamics", "FmuError", "Simulated", "fmu_class", "is_of_an_fmu", "load_fmu"]
