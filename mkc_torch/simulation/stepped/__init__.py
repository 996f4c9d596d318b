"""Simulations that step, in any engine."""

from mkc_torch.simulation.stepped.mujoco import MjcfError, load_mjcf, mjcf_class
from mkc_torch.simulation.stepped.stepper import Stepper

__all__ = ["MjcfError", "Stepper", "load_mjcf", "mjcf_class"]
