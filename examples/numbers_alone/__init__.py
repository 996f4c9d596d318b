"""A diagnosis of a MuJoCo model, compared with a fit of its numbers alone by `mujoco.sysid`."""
