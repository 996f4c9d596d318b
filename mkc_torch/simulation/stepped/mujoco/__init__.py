"""Models of MuJoCo, in MJCF or URDF (mujoco.readthedocs.io), as simulations that step."""

from mkc_torch.simulation.stepped.mujoco.description import MjcfError
from mkc_torch.simulation.stepped.mujoco.stepper import MujocoStepper, is_of_a_model, load_mjcf, mjcf_class

__all__ = ["MjcfError", "MujocoStepper", "is_of_a_model", "load_mjcf", "mjcf_class"]
