"""`mkc effects` lists the catalogue, and where effects can act in a simulation, as `suspected_terms` accepts it."""

import json

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")

from mkc_torch.cli.console import ConsoleStyle
from mkc_torch.cli.effects_summary import declared_places, show
from mkc_torch.diagnosis.model.shapes import candidates_of
from mkc_torch.diagnosis.model.suspect import suspected_terms
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.simulation import Paired, load_simulation
from tests.cli.commands import assert_refused, mkc

CART = """
from mkc_torch.simulation import Dynamics, Static

class Cart(Dynamics):
    states, inputs, outputs = ("x", "speed"), ("command",), ("x",)
    units = {"x": "m", "speed": "m/s"}
    parameters = {"stiffness": 2.0}

    def derivative(self, time, x, u, p):
        return {"x": x.speed, "speed": u.command - p.stiffness * x.x}

class Broken(Cart):
    def derivative(self, time, x, u, p):
        return {"x": x.position}
"""

TIME = 0.1 * torch.arange(80, dtype=torch.float64)


@pytest.fixture
def files(tmp_path):
    """Return `--simulation` of a cart, and a recording of it with two further columns."""
    (tmp_path / "cart.py").write_text(CART)
    columns = {"time": TIME, "command": TIME.sin(), "x": (1.3 * TIME).sin(), "slope": (0.7 * TIME).cos()}
    write_table(tmp_path / "ride.csv", columns | {"temperature": 20.0 + TIME.cos(), "fixed": 0.0 * TIME})
    return f"{tmp_path / 'cart.py'}:Cart", tmp_path / "ride.csv"


def data_of(*arguments):
    done = mkc("effects", *arguments, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def suspects(data):
    return [place["suspect"] for effect in data["effects"] for place in effect["places"]]


def test_every_effect_of_the_catalogue_is_listed_with_its_explanation():
    lines = mkc("effects").stdout.splitlines()
    for effect in CATALOGUE:
        assert any(line.split()[0] == effect.id and line.endswith(effect.explanation) for line in lines), effect.id
    data = data_of()
    assert (data["simulation"], data["exact"]) == (None, False)
    assert {effect["id"] for effect in data["effects"]} == {effect.id for effect in CATALOGUE}
    assert {port for effect in data["effects"] for port in effect["ports"]} == {effect.port for effect in CATALOGUE}


def test_the_places_in_a_recording_are_those_of_a_diagnosis(files):
    simulation, recording = files
    data = data_of(recording, "--simulation", simulation)
    assert (data["simulation"], data["exact"]) == ("Cart", True)
    cart = load_simulation(simulation)
    prepared = cart.prepare(Recording.read(recording, recognise=False))
    terms = candidates_of(cart, prepared, CATALOGUE, DriverSettings())[1]
    chosen = {term.key for text in suspects(data) for found in suspected_terms(text, terms, prepared) for term in found}
    assert chosen == {term.key for term in terms}
    assert "driver_input_gain@command(slope)" in suspects(data)
    assert "gain" in data["without_place"]
    assert data["notes"] == ["Column `fixed` is constant and can drive nothing."]


def test_without_a_recording_the_places_are_those_that_the_states_and_inputs_allow(files):
    simulation, recording = files
    lines = mkc("effects", "--simulation", simulation).stdout.splitlines()
    assert "coulomb_friction@speed" in [line.split("  ")[0] for line in lines]
    assert any(line.startswith("driver_force@speed(COLUMN)  ") for line in lines)
    assert "note: with a recording, REC, the list is exact." in lines
    data = data_of("--simulation", simulation)
    assert not data["exact"]
    exact = suspects(data_of(recording, "--simulation", simulation))
    known = {text.replace("(slope)", "(COLUMN)").replace("(temperature)", "(COLUMN)") for text in exact}
    assert known <= set(suspects(data))


def test_a_simulators_output_needs_no_recording(files):
    _, table = files
    data = data_of("--simulator-output", table)
    assert {"gain@x", "driver_gain@x(COLUMN)", "clock_drift@all outputs"} <= set(suspects(data))


def test_a_magnetometer_is_recognised_by_its_columns(tmp_path):
    path = tmp_path / "flight.csv"
    write_table(path, simulated_recording()[0].columns)
    data = data_of(path)
    assert data["simulation"] == "magnetometer"
    assert "hard_iron_step@sensor" in suspects(data)
    assert set(suspects(data_of("--simulation", "magnetometer"))) >= {"hard_iron_step@sensor", "heading_reset@heading"}


def test_runs_that_are_diagnosed_separately_are_not_joined(tmp_path):
    (tmp_path / "line.py").write_text(
        "from mkc_torch.simulation import Static\n"
        "class Rod(Static):\n"
        "    inputs, outputs, parameters = ('heat',), ('length',), {'slope': 0.1}\n"
        "    def output(self, time, u, p):\n"
        "        return {'length': p.slope * u.heat}\n"
    )
    run = (TIME > 4.0).double()
    columns = {"time": TIME, "heat": TIME.sin(), "length": TIME.cos(), "experiment": run, "fan": run * TIME}
    write_table(tmp_path / "runs.csv", columns)
    data = data_of(tmp_path / "runs.csv", "--simulation", tmp_path / "line.py")
    assert data["notes"] == ["Column `fan` is constant and can drive nothing."]


def test_a_terminal_shows_an_explanation_once_for_all_places_of_an_effect():
    summary = declared_places(Paired(Recording({"time": TIME, "left": TIME.sin(), "right": TIME.cos()})))
    text = ConsoleStyle(terminal=True, width=200).set(lambda console: show(console, summary))
    assert {"gain@left", "gain@right"} <= set(text.split())
    assert text.count("is a constant share larger, or smaller") == 1


def test_bad_arguments_are_refused_in_one_line(files, tmp_path):
    simulation, recording = files
    assert_refused(mkc("effects", "--simulation", "cart"), '--simulation "cart" is unknown', code=2)
    assert_refused(mkc("effects", "--simulation", simulation, "--convert", "time=us"), "give REC", code=2)
    assert_refused(mkc("effects", tmp_path / "no.csv", "--simulation", simulation), "no.csv")
    assert_refused(mkc("effects", "--simulation", tmp_path / "no.py"), "there is no such file")
    assert_refused(mkc("effects", recording), "give --simulation or --simulator-output")


def test_an_error_in_the_users_equations_is_shown_with_its_line(files):
    simulation, _ = files
    done = mkc("effects", "--simulation", simulation.replace(":Cart", ":Broken"))
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    assert "cart.py: Broken raised an error of its own." in done.stderr
    assert 'return {"x": x.position}' in done.stderr
