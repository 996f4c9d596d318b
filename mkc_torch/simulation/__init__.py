"""Simulations: what predicts a recording, with ports through which an effect can act on it."""

from mkc_torch.simulation.magnetometer import Magnetometer
from mkc_torch.simulation.protocol import Correction, Port, PreparedSimulation, Simulation

__all__ = ["Correction", "Magnetometer", "Port", "PreparedSimulation", "Simulation"]
