"""Simulations of recordings, with ports at which effects can act."""

from mkc_torch.simulation.dynamics.definition import Dynamics
from mkc_torch.simulation.fmu import FmuError, fmu_class, load_fmu
from mkc_torch.simulation.load import SimulationFileError, base_class, load_simulation
from mkc_torch.simulation.magnetometer import Magnetometer
from mkc_torch.simulation.paired import Paired
from mkc_torch.simulation.parameter import Parameter, SimulationError
from mkc_torch.simulation.ports import Port
from mkc_torch.simulation.protocol import Correction, PreparedSimulation, Simulation
from mkc_torch.simulation.static import Static
from mkc_torch.simulation.stepped import MjcfError, Stepper, load_mjcf, mjcf_class

__all__ = [
    "Correction",
    "Dynamics",
    "FmuError",
    "Magnetometer",
    "MjcfError",
    "Paired",
    "Parameter",
    "Port",
    "PreparedSimulation",
    "Simulation",
    "SimulationError",
    "SimulationFileError",
    "Static",
    "Stepper",
    "base_class",
    "fmu_class",
    "load_fmu",
    "load_mjcf",
    "load_simulation",
    "mjcf_class",
]
