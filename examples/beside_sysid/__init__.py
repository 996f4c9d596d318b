"""The diagnosis of a MuJoCo model beside a fit of its numbers alone, by `mujoco.sysid`."""
