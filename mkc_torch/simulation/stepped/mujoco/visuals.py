"""Parts of a MuJoCo model that only are seen: neither a step nor a diagnosis needs them, nor their files."""

from __future__ import annotations

from typing import Any

import mujoco


def drop_visuals(spec: Any) -> None:
    """Remove geoms that neither collide nor weigh, and the meshes, textures and skins that no other geom uses.

    A geom weighs where its body has no inertia of its own. Files of removed meshes may be missing.

    Args:
        spec: ``MjSpec`` of the model, which is changed.
    """
    for geom in list(spec.geoms):
        body = geom.parent
        if geom.contype == 0 and geom.conaffinity == 0 and (body.explicitinertial or body.name == spec.worldbody.name):
            spec.delete(geom)
    for skin in list(spec.skins):
        spec.delete(skin)
    used = {geom.meshname for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
    for geom in spec.geoms:
        geom.material = ""
    for part in (*spec.materials, *spec.textures):
        spec.delete(part)
