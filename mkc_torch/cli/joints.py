"""Which joints of a MuJoCo model a diagnosis moves by simulation, for ``--joints``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mkc_torch._support.files import write_atomically
from mkc_torch.cli.console import FAILURES
from mkc_torch.cli.diagnosis_files import read_recording, simulation_of
from mkc_torch.cli.diagnosis_request import Request, is_model_of_mujoco
from mkc_torch.cli.simulation_option import ALL, EACH, MOST_TOGETHER


def by_joints(path: Path, request: Request) -> list[Request]:
    """Return a request for each joint of a MuJoCo model that is simulated by itself; else the request alone.

    Args:
        path: of the recording; a file that cannot be read is left to the diagnosis, which reports it.
        request: for all joints.
    """
    if not is_model_of_mujoco(request.simulation) or request.joints not in ((), (EACH,)):
        return [replace(request, joints=()) if request.joints == (ALL,) else request]
    whole = replace(request, joints=())
    try:
        recording, simulation = read_recording(path, whole), simulation_of(whole)
    except FAILURES:
        return [whole]
    joints = list(getattr(simulation, "positions", ()))
    measured = [name for name in joints if name in recording]
    each = request.joints == (EACH,) or (len(measured) > MOST_TOGETHER and len(measured) == len(joints))
    return [replace(request, joints=(name,)) for name in measured] if each else [whole]


def write_joined(folder: Path, requests: Sequence[Request]) -> Path | None:
    """Write the model's file with the findings of all joints; None if a joint has no model.

    Args:
        folder: of the recording, with a folder for each joint.
        requests: of the joints.
    """
    from mkc_torch.diagnosis.io.mjcf import mjcf_source
    from mkc_torch.diagnosis.io.model import DiagnosedModel

    models = []
    for request in requests:
        place = folder / request.joints[0] / "model.json"
        if not place.exists():
            return None
        model = DiagnosedModel.from_json(place.read_text("utf-8"), simulation=simulation_of(request))
        models.append(model.mjcf_part())
    target = folder / "corrected.xml"
    write_atomically(target, mjcf_source(models)[0], overwrite=requests[0].force)
    return target
