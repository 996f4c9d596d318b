"""The recordings with known missing physics, and their right answers."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Request

SHARED = Path(__file__).resolve().parents[3] / "shared"
"""Folder of the recordings, next to the project's folder."""


@dataclass(frozen=True)
class Size:
    """Right value of a parameter; ``within`` is the relative tolerance, ``errors`` the number of standard errors."""

    effect: str
    parameter: str
    value: float
    within: float = 0.0
    errors: float = 0.0


@dataclass(frozen=True)
class Expected:
    """The accepted answers for a recording.

    Attributes:
        names: groups of accepted effects; each group needs a claimed effect, or an alternative that cannot be ruled
            out. None: no effect may be claimed.
        places: substrings, one of which has to be in a channel of a claimed effect of these names; empty for any place.
        refused: effects that may not be claimed.
        verdicts: accepted verdicts; empty for any.
        sizes: right values of parameters.
        residual: largest accepted RMS residual of the open-loop simulation, by output, in its unit.
        phrases: phrases of an advice or warning, all of which together are accepted in place of a claim.
    """

    names: Sequence[Sequence[str]] = ()
    places: Sequence[str] = ()
    refused: Sequence[str] = ()
    verdicts: Sequence[str] = ()
    sizes: Sequence[Size] = ()
    residual: Mapping[str, float] = field(default_factory=dict)
    phrases: Sequence[str] = ()


@dataclass(frozen=True)
class Known:
    """A recording, its simulation as ``FILE.py:CLASS`` or the file of a simulator's output, and the right answer.

    Attributes:
        name: what the table calls it.
        recording: its file, or the file or folder that ``cut`` makes it of.
        simulation, expected: as above.
        input_hold: what inputs do between samples, where it is not left to the diagnosis.
        cut: the columns to diagnose, of ``recording``; None for all of it as it is.
    """

    name: str
    recording: Path
    simulation: str
    expected: Expected
    input_hold: Mapping[str, str] = field(default_factory=dict)
    cut: Callable[[Path], Mapping[str, Any]] | None = None

    @property
    def file(self) -> Path:
        """File of the simulation; that of the recording for a simulation of the library."""
        if self.simulation == MAGNETOMETER:
            return self.recording
        return Path(self.simulation.rpartition(":")[0] or self.simulation)

    def file_in(self, folder: Path) -> Path:
        """Return the file to diagnose; cut columns are written into a folder."""
        if self.cut is None:
            return self.recording
        from mkc_torch.recording.recording import write_table

        file = folder / "recording.csv"
        write_table(file, self.cut(self.recording), overwrite=True)
        return file

    @property
    def request(self) -> Request:
        if self.simulation.endswith(".csv"):
            return Request(simulation="", simulator_output=self.file, force=True, report=False)
        return Request(simulation=self.simulation, input_hold=self.input_hold, force=True, report=False)


SYSTEMS = Path(__file__).resolve().parent / "dynamics" / "systems.py"
"""Simulations of the recordings in ``data``."""

_COLOURED = ("Blue_Basketball", "Green_Basketball", "Orange_Whiffle_Ball", "Yellow_Whiffle_Ball")
HEAVY = ("Bowling_Ball", "Golf_Ball")
"""Balls whose drag is too small to be detected in a drop."""

BALLS = ("Baseball", *_COLOURED, "Tennis_Ball", "Volleyball", "Whiffle_Ball_1", "Whiffle_Ball_2", *HEAVY)

DRAG = "quadratic_drag"
CURVE = "unknown"
HIDDEN_STORE = "hidden_lag"
LATE = ("input_delay", "input_lag", "hidden_lag", "sensor_lag")
USEFUL = ("explained", "unexplained")


def real(shared: Path = SHARED) -> Iterator[Known]:
    """The real recordings in a folder like :data:`SHARED`."""
    folder = shared / "real"
    hidden_mass = Expected(((HIDDEN_STORE,),), verdicts=USEFUL)
    for number in (1, 2):
        yield _known(folder, "house", f"house_{number}.csv", "House", hidden_mass)
    # this simulation has a lag that absorbs the delay
    pan = Expected((("backlash",),), sizes=(Size("backlash", "half_gap", 0.010, within=0.1),), residual={"pan": 0.0029})
    yield _known(folder, "so101", "pan.csv", "Servo", pan)
    play = Expected(
        (("backlash",), ("delay", "input_delay", "sensor_lag"), ("offset", "gravity_sag")),
        residual={"pan": 1.2 * 0.0024},
    )
    yield Known("real so101 recording", folder / "so101" / "recording.csv", str(folder / "so101" / "command.csv"), play)
    drag = Expected(
        ((DRAG,),), sizes=(Size(DRAG, "drag", 9.2e-5, within=0.1, errors=2.0),), residual={"altitude": 1.2 * 2.2}
    )
    yield _known(folder, "rocket", "juno.csv", "Rocket", drag)
    friction = Expected((("coulomb_friction", DRAG),), refused=("stribeck_friction",), residual={"angle": 1.2 * 0.0061})
    yield _known(folder, "pendulum_encoder", "run.csv", "Pendulum", friction)
    loss = Expected((("power_law",),), refused=("overflow",), residual={"temp": 1.2 * 0.22})
    yield _known(folder, "mug", "run.csv", "Cooling", loss)


def cases(shared: Path = SHARED) -> Iterator[Known]:
    """The kept cases, most of them simulated, in a folder like :data:`SHARED`."""
    folder = shared / "cases"
    drag = Expected(((DRAG,),), sizes=(Size(DRAG, "drag", 9.24e-5, errors=2.0),))
    for name in ("white", "w2", "c05", "c2s", "coloured", "c2f"):
        yield _known(folder, "coloured_sensor", f"{name}.csv", "Rocket", drag)
    mode = (("hidden_mode",),)
    # a fit of the exact response to a torque that is linear between samples, to 0.0028 rad and 0.052 rad/s; the values
    # that came with the file (0.833, 0.1405 s, 0.0224) leave 1.4 rad/s
    sizes = {"share": 0.844, "period": 0.2229, "damping": 0.0173}
    stiff = Expected(mode, sizes=[Size("hidden_mode", name, value, errors=2.0) for name, value in sizes.items()])
    yield _known(folder, "two_mass", "stiff_240.csv", "Drive", stiff)
    yield _known(folder, "two_mass", "resonant_600.csv", "Drive", Expected(mode))
    arm = Expected((("input_square", "dead_zone", "power_law", CURVE), LATE), residual={"angle": 0.045})
    yield _known(folder, "propeller_arm", "run.csv", "Arm", arm, between={"voltage": "held"})
    # the lower tank can overflow too (Schoukens & Noël, IFAC World Congress 2017), so a claim there is not refused
    overflow = Expected((("overflow", CURVE),), places=("level1",), residual={"level2": 1.2 * 0.41})
    yield _known(folder, "tanks", "fit.csv", "Tanks", overflow)
    air = Expected(
        ((DRAG,),), sizes=(Size(DRAG, "drag", 0.00047, within=0.32),), phrases=("quadratic_drag", "would explain")
    )
    yield _known(folder, "coastdown", "runs.csv", "Coast", air)
    yield _known(folder, "ball_beam", "run.csv", "Ball", Expected(verdicts=("unfit",)))
    ground = Expected(((CURVE,),), places=("climb", "height"), residual={"height": 0.02})
    yield _known(folder, "altitude", "runs.csv", "Altitude", ground)
    convection = Expected((("power_law", CURVE),), refused=("thermal_loss",), verdicts=USEFUL)
    yield _known(folder, "heater", "runs.csv", "Heater", convection)
    friction = Expected((("coulomb_friction", "stribeck_friction"),))
    yield _known(folder, "gear_motor", "runs.csv", "GearMotor", friction)
    yield from _simulated(folder)


def _simulated(folder: Path) -> Iterator[Known]:
    """Six runs of a driven pendulum: nothing missing, with a disturbance, or not explained by the simulation."""
    adequate, disturbed, unfit = Expected(verdicts=("adequate",)), Expected(verdicts=("unexplained",)), ("unfit",)
    for name in ("held_input", "linear_input"):
        yield _known(folder, f"simulated/{name}", "run.csv", "Pendulum", adequate)
    for name in ("pushed_slowly", "pushed_white", "gusts"):
        yield _known(folder, f"simulated/{name}", "run.csv", "Pendulum", disturbed)
    yield _known(folder, "simulated/unrelated", "run.csv", "Pendulum", Expected(verdicts=unfit))
    yield _known(folder, "simulated/held_input", "run.csv", "UpsideDown", Expected(verdicts=unfit))


def strangers(shared: Path = SHARED) -> Iterator[Known]:
    """Recordings that the project had not seen when they were tried first, in a folder like :data:`SHARED`.

    The residuals are 1.15 times that of a fit by hand with as many effects.
    """
    folder = shared / "cases" / "strangers"

    def stranger(name: str, simulation: str, expected: Expected) -> Known:
        file = f"{folder / name / 'naive.py'}:{simulation}"
        return Known(f"strangers {name}", folder / name / "run.csv", file, expected)

    friction = Expected((("coulomb_friction",),), residual={"angle": 1.15 * 0.0139})
    yield stranger("motor_pendulum", "Pendulum", friction)
    thrust = Expected((("input_square", "power_law"), ("coulomb_friction",)), residual={"angle": 1.15 * 0.0400})
    yield stranger("quarter_drone", "Arm", thrust)
    polarisation = Expected((("input_lag", HIDDEN_STORE),), residual={"voltage": 1.15 * 0.00383})
    yield stranger("battery_cell", "Cell", polarisation)
    drain = Expected((("overflow",),), refused=("backlash",), residual={"head": 1.15 * 0.0839})
    yield stranger("groundwater_threshold", "Head", drain)
    yield stranger("cogging_motor", "Motor", Expected((("coulomb_friction",), ("position_periodic_force",))))
    tilted = Expected((("constant_force",), ("coulomb_friction", "stribeck_friction")), verdicts=USEFUL)
    yield stranger("tilted_cart", "Cart", tilted)
    clock = Expected((("sensor_clock_drift",),), verdicts=USEFUL, residual={"position": 1.15 * 0.0111})
    yield stranger("fast_clock", "Stage", clock)
    yield stranger("wrong_sign", "Pendulum", Expected(verdicts=("unfit", "unexplained")))
    # the lift multiplies the thrust, so the battery acts on either
    battery = ("driver_input_gain", "driver_parameter", "driver_parameter_quadratic")
    yield stranger("sagging_battery", "Quad", Expected((battery,), verdicts=USEFUL))
    heat = ("driver_parameter_arrhenius", "driver_parameter_quadratic", "driver_parameter")
    yield stranger("warm_cell", "Cell", Expected((heat,), ("parameter",), ("driver_input_gain",)))


def data(shared: Path = SHARED) -> Iterator[Known]:
    """Public recordings with known missing physics that are read as they are, in a folder like :data:`SHARED`."""
    folder = shared / "data"
    dynamics = folder / "dynamics"
    coupled = Expected((("coupling",), LATE), refused=("thermal_loss",))
    yield Known("data heaters run_1s Heaters", dynamics / "heaters" / "run_1s.csv", f"{SYSTEMS}:Heaters", coupled)
    drops = dynamics / "falling_balls" / "ball_drops.csv"
    for name in BALLS:
        drag = Expected() if name in HEAVY else Expected(((DRAG, "linear_drag"),))
        yield Known(f"data falling_balls {name} Ball", drops, f"{SYSTEMS}:Ball", drag, cut=partial(first_drop, name))
    spring = Expected((("cubic_stiffness",),))
    resonator = dynamics / "silverbox" / "silverbox.csv"
    yield Known("data silverbox Silverbox", resonator, f"{SYSTEMS}:Silverbox", spring, cut=multisine)
    friction = Expected((("coulomb_friction", "load_dependent_friction", "stribeck_friction"),))
    yield Known("data servo Servo", dynamics / "servo", f"{SYSTEMS}:Servo", friction, cut=driven_servo)
    step = Expected((("hard_iron_step",),))
    for name in ("broad_34_attached_magnet_3cm", "broad_36_attached_magnet_5cm"):
        yield Known(f"data {name}", folder / "magnetometer" / f"{name}.csv", MAGNETOMETER, step)
    others = {"broad_21_undisturbed_fast": "field_gradient", "quadrotor_compass1": "heading_reset"}
    for name, effect in (others | {"quadrotor_compass3": "current_field"}).items():
        yield Known(f"data {name}", folder / "magnetometer" / f"{name}.csv", MAGNETOMETER, Expected(((effect,),)))


def first_drop(ball: str, drops: Path) -> Mapping[str, Any]:
    """A ball's first drop of two."""
    from mkc_torch import Recording

    drop = Recording.read(drops).experiments()[f"{ball}/1"]
    return {"time": drop["time"], "height": drop["height"]}


def multisine(table: Path) -> Mapping[str, Any]:
    """The part of a multisine on which the Silverbox is trained."""
    found: Mapping[str, Any] = runpy.run_path(str(SYSTEMS))["silverbox"](table.parents[1]).train.columns
    return found


def driven_servo(folder: Path) -> Mapping[str, Any]:
    """The servo's runs at two gains of its controller, in one table."""
    found: Mapping[str, Any] = runpy.run_path(str(SYSTEMS))["servo"](folder.parent).train.columns
    return found


def _known(
    place: Path, folder: str, file: str, name: str, expected: Expected, between: Mapping[str, str] | None = None
) -> Known:
    recording = place / folder / file
    own = recording.parent / "naive.py"
    simulation = f"{own if own.is_file() else recording.parent.parent / 'naive.py'}:{name}"
    return Known(f"{place.name} {folder} {recording.stem} {name}", recording, simulation, expected, between or {})
