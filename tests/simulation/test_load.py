import sys

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, SimulationError, SimulationFileError, load_simulation
from mkc_torch.simulation.load import raised_in

VALID_SOURCE = """
from mkc_torch.simulation import Dynamics
from neighbour import RATE

class Decay(Dynamics):
    states = ("level",)
    parameters = {"rate": RATE}

    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level}

ready = Decay()
NUMBER = 3
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "neighbour.py").write_text("RATE = 0.5\n")
    path = tmp_path / "my.py"
    path.write_text(VALID_SOURCE)
    yield path
    sys.modules.pop("neighbour", None)


def test_a_class_or_an_instance_is_loaded(file):
    for name in ("Decay", "ready"):
        assert load_simulation(f"{file}:{name}").name == "Decay"
    assert str(file.parent) not in sys.path


def test_a_relative_path_is_loaded_and_its_errors_show_the_line(file, monkeypatch):
    monkeypatch.chdir(file.parent)
    assert load_simulation("my.py:Decay").name == "Decay"
    file.write_text("1 / 0")
    with pytest.raises(SimulationFileError, match=r'raised an error of its own.\n  File ".*my.py", line 1'):
        load_simulation("my.py:Decay")


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("my.py", "defines 2 simulations; give --simulation my.py:Decay or"),
        ("my.txt:Decay", "does not name a simulation"),
        ("other.py:Decay", "there is no such file"),
        ("my.py:Missing", "defines no `Missing`; simulations in it: Decay, ready."),
        ("my.py:NUMBER", "`NUMBER` is not a simulation"),
    ],
)
def test_invalid_sources_are_refused_with_the_remedy(file, monkeypatch, source, words):
    monkeypatch.chdir(file.parent)
    with pytest.raises(SimulationFileError, match=words):
        load_simulation(source)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\nraise KeyError('gone')\n", ["line 2", "raise KeyError('gone')", "KeyError: 'gone'"]),
        ("def f(:\n", ["SyntaxError"]),
        ("import sys\nsys.exit(3)\n", ["SystemExit: 3"]),
        ("import no_such_module_here\n", ["ModuleNotFoundError"]),
        (
            "class Decay:\n    def __init__(self):\n        self.x = undefined\n",
            ["Decay() raised", "NameError", "line 3"],
        ),
    ],
)
def test_errors_of_a_file_show_the_lines_of_the_user(tmp_path, text, words):
    path = tmp_path / "my.py"
    path.write_text(text)
    with pytest.raises(SimulationFileError) as caught:
        load_simulation(f"{path}:Decay")
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    for word in words:
        assert word in message
    assert "importlib" not in message
    assert "_simulation_my" not in sys.modules or "Decay()" in message


def test_errors_during_a_simulation_show_the_lines_of_the_user(tmp_path):
    path = tmp_path / "my.py"
    path.write_text(
        VALID_SOURCE.replace("from neighbour import RATE", "RATE = 1.0").replace(
            "p.rate * x.level", "p.speed * x.level"
        )
    )
    simulation = load_simulation(f"{path}:Decay")
    time = torch.arange(0.0, 5.0, 0.1)
    with pytest.raises(AttributeError) as caught:
        simulation.prepare(Recording({"time": time, "level": torch.exp(-time)}))
    message = str(raised_in(f"{path}:Decay", caught.value))
    assert "Decay raised an error of its own" in message
    assert "p.speed" in message
    assert "dynamics.py" not in message
    assert raised_in(f"{path}:Decay", ValueError("elsewhere")) is None


class DynamicsReturning(Dynamics):
    states = ("level",)
    parameters = {"rate": 0.5}

    def __init__(self, value):
        self.value = value

    def derivative(self, time, x, u, p):
        return self.value(x)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (lambda x: {"level": x.level[:3]}, r"rate of `level` should be a tensor of shape \(\d+,\)"),
        (lambda _: {"level": 1.0}, "is float"),
        (lambda x: (x.level, x.level), "returns 2 rates for 1 states"),
        (lambda x: {"speed": x.level}, "returns rates of speed but the states are level"),
        (lambda x: {"level": (x.level - 10.0).sqrt()}, "is nan at time 0 s with level = 1; parameters rate = 0.5"),
    ],
)
def test_invalid_derivatives_are_refused_with_the_reason(value, words):
    time = torch.arange(0.0, 5.0, 0.1)
    with pytest.raises(SimulationError, match=words):
        DynamicsReturning(value).prepare(Recording({"time": time, "level": torch.exp(-time)}))


def test_a_file_elsewhere_imports_modules_of_the_current_folder(tmp_path, monkeypatch):
    """For example, a corrected.py in a folder of results imports its base class."""
    (tmp_path / "own_base_of_a_test.py").write_text(BASE_SOURCE, encoding="utf-8")
    results = tmp_path / "results"
    results.mkdir()
    (results / "corrected.py").write_text(
        "from own_base_of_a_test import Base\n\n\nclass Corrected(Base):\n    parameters = {'rate': 2.0}\n",
        encoding="utf-8",
    )
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    simulation = load_simulation(f"{results / 'corrected.py'}:Corrected")
    assert simulation.parameters == {"rate": 2.0}
    assert sys.path == before
    sys.modules.pop("own_base_of_a_test")


def test_a_file_imports_another_file_of_its_name(tmp_path, monkeypatch):
    """For example, a corrected.py of another corrected.py."""
    (tmp_path / "corrected.py").write_text(BASE_SOURCE, encoding="utf-8")
    results = tmp_path / "results"
    results.mkdir()
    (results / "corrected.py").write_text(
        "from corrected import Base\n\n\nclass Corrected(Base):\n    parameters = {'rate': 2.0}\n", encoding="utf-8"
    )
    monkeypatch.chdir(tmp_path)
    finders = list(sys.meta_path)
    assert load_simulation("results/corrected.py:Corrected").parameters == {"rate": 2.0}
    assert load_simulation("corrected.py:Base").parameters == {"rate": 1.0}
    assert sys.meta_path == finders
    sys.modules.pop("corrected", None)


def test_a_missing_base_is_refused_with_the_remedy(tmp_path):
    (tmp_path / "corrected.py").write_text("from nowhere_to_be_found import Base\n", encoding="utf-8")
    with pytest.raises(SimulationFileError, match=r"put nowhere_to_be_found\.py there"):
        load_simulation(f"{tmp_path / 'corrected.py'}:Base")


BASE_SOURCE = """
from mkc_torch.simulation import Dynamics


class Base(Dynamics):
    states = ("level",)
    parameters = {"rate": 1.0}

    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level}
"""
