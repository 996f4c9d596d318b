"""``--simulation FILE.py`` without a class, and functions that do not accept tensors."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.simulation.load import SimulationFileError, load_simulation, raised_in

SOURCE = """
import math
import numpy
import torch
from mkc_torch.simulation import Dynamics


class {name}(Dynamics):
    states = ("speed",)
    outputs = ("speed",)
    parameters = {{"drag": 1.0}}

    def derivative(self, time, x, u, p):
        return {{"speed": -p.drag * {function}(x.speed)}}
"""


def write(tmp_path, *names, function="torch.sin"):
    path = tmp_path / "motor.py"
    path.write_text("".join(SOURCE.format(name=name, function=function) for name in names))
    return str(path)


def test_the_single_class_of_a_file_is_loaded(tmp_path):
    assert type(load_simulation(write(tmp_path, "Motor"))).__name__ == "Motor"


def test_several_classes_are_listed_as_options(tmp_path):
    path = write(tmp_path, "Motor", "Servo")
    with pytest.raises(SimulationFileError, match="2 simulations") as error:
        load_simulation(path)
    assert f"--simulation {path}:Motor or --simulation {path}:Servo" in str(error.value)


def test_a_file_without_a_simulation_and_a_missing_file_are_refused(tmp_path):
    (tmp_path / "empty.py").write_text("x = 1\n")
    with pytest.raises(SimulationFileError, match="no simulation"):
        load_simulation(str(tmp_path / "empty.py"))
    with pytest.raises(SimulationFileError, match="no such file"):
        load_simulation(str(tmp_path / "nowhere.py"))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("function", ["math.sin", "numpy.sin", "float"])
def test_errors_of_math_and_numpy_functions_name_those_of_torch(tmp_path, function):
    path = write(tmp_path, "Motor", function=function)
    time = torch.arange(60) / 20.0
    recording = Recording({"time": time, "speed": torch.exp(-time)})
    with pytest.raises(Exception) as error:  # noqa: PT011 - several types, compared below
        diagnose(load_simulation(path), recording, quick=True)
    assert "torch.sin" in str(raised_in(path, error.value))
