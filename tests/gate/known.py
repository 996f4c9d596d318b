"""The recordings whose missing physics is known, and their right answers by the tables beside them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mkc_torch.cli.diagnosis_request import Request
from tests.gate.judge import Expected, Size
from tests.shared_data import CASES

REAL = CASES.parent / "real"


@dataclass(frozen=True)
class Known:
    """A recording, its simulation as ``FILE.py:CLASS`` or the file of a simulator's output, and the right answer."""

    name: str
    recording: Path
    simulation: str
    expected: Expected
    between: Mapping[str, str] = field(default_factory=dict)

    @property
    def file(self) -> Path:
        """The simulation's file."""
        return Path(self.simulation.rpartition(":")[0] or self.simulation)

    @property
    def request(self) -> Request:
        if self.simulation.endswith(".csv"):
            return Request(simulation="", simulated=self.file, force=True, report=False)
        return Request(simulation=self.simulation, between=self.between, force=True, report=False)


DRAG = "quadratic_drag"
CURVE = "unknown"
HIDDEN_STORE = "hidden_lag"
LATE = ("input_delay", "input_lag", "hidden_lag", "sensor_lag")
USEFUL = ("explained", "unexplained")


def real() -> Iterator[Known]:
    """The real recordings."""
    hidden_mass = Expected(((HIDDEN_STORE,),), verdicts=USEFUL)
    for number in (1, 2):
        yield _known(REAL, "house", f"house_{number}.csv", "House", hidden_mass)
    pan = Expected((("backlash",), ("input_delay", "input_lag", "delay", "sensor_lag")), residual={"pan": 1.2 * 0.0024})
    yield _known(REAL, "so101", "pan.csv", "Servo", pan)
    play = Expected(
        (("backlash",), ("delay", "input_delay", "sensor_lag"), ("offset", "gravity_sag")),
        residual={"pan": 1.2 * 0.0024},
    )
    yield Known("real so101 recording", REAL / "so101" / "recording.csv", str(REAL / "so101" / "command.csv"), play)
    drag = Expected(((DRAG,),), sizes=(Size(DRAG, "drag", 9.2e-5, within=0.1),), residual={"altitude": 1.2 * 2.2})
    yield _known(REAL, "rocket", "juno.csv", "Rocket", drag)
    friction = Expected((("coulomb_friction", DRAG),), refused=("stribeck_friction",), residual={"angle": 1.2 * 0.0061})
    yield _known(REAL, "pendulum_encoder", "run.csv", "Pendulum", friction)
    loss = Expected((("power_law",),), refused=("overflow",), residual={"temp": 1.2 * 0.22})
    yield _known(REAL, "mug", "run.csv", "Cooling", loss)


def cases() -> Iterator[Known]:
    """The kept cases, most of them simulated."""
    drag = Expected(((DRAG,),), sizes=(Size(DRAG, "drag", 9.24e-5, errors=2.0),))
    for name in ("white", "w2", "c05", "c2s", "coloured", "c2f"):
        yield _known(CASES, "coloured_sensor", f"{name}.csv", "Rocket", drag)
    mode = (("hidden_mode",),)
    sizes = {"share": 0.833, "period": 0.1405, "damping": 0.0224}
    stiff = Expected(mode, sizes=[Size("hidden_mode", name, value, errors=2.0) for name, value in sizes.items()])
    yield _known(CASES, "two_mass", "stiff_240.csv", "Drive", stiff)
    yield _known(CASES, "two_mass", "resonant_600.csv", "Drive", Expected(mode))
    arm = Expected((("input_square", "dead_zone", "power_law", CURVE), LATE), residual={"angle": 0.045})
    yield _known(CASES, "propeller_arm", "run.csv", "Arm", arm, between={"voltage": "held"})
    overflow = Expected((("overflow", CURVE),), places=("level1",), residual={"level2": 1.2 * 0.41})
    yield _known(CASES, "tanks", "fit.csv", "Tanks", overflow)
    air = Expected(
        ((DRAG,),), sizes=(Size(DRAG, "drag", 0.00047, within=0.32),), words=("quadratic_drag", "would explain")
    )
    yield _known(CASES, "coastdown", "runs.csv", "Coast", air)
    yield _known(CASES, "ball_beam", "run.csv", "Ball", Expected(verdicts=("unfit",)))
    ground = Expected(((CURVE,),), places=("climb", "height"), residual={"height": 0.02})
    yield _known(CASES, "altitude", "runs.csv", "Altitude", ground)
    convection = Expected((("power_law", CURVE),), refused=("thermal_loss",), verdicts=USEFUL)
    yield _known(CASES, "heater", "runs.csv", "Heater", convection)
    friction = Expected((("coulomb_friction", "stribeck_friction"),))
    yield _known(CASES, "gear_motor", "runs.csv", "GearMotor", friction)
    yield from _simulated()


def _simulated() -> Iterator[Known]:
    """Six runs of a driven pendulum: nothing missing, driven by an unrecorded disturbance, or not to be followed."""
    adequate, pushed, unfit = Expected(verdicts=("adequate",)), Expected(verdicts=("unexplained",)), ("unfit",)
    for name in ("held_input", "linear_input"):
        yield _known(CASES, f"simulated/{name}", "run.csv", "Pendulum", adequate)
    for name in ("pushed_slowly", "pushed_white", "gusts"):
        yield _known(CASES, f"simulated/{name}", "run.csv", "Pendulum", pushed)
    yield _known(CASES, "simulated/unrelated", "run.csv", "Pendulum", Expected(verdicts=unfit))
    yield _known(CASES, "simulated/held_input", "run.csv", "UpsideDown", Expected(verdicts=unfit))


def _known(
    place: Path, folder: str, file: str, name: str, expected: Expected, between: Mapping[str, str] | None = None
) -> Known:
    recording = place / folder / file
    own = recording.parent / "naive.py"
    simulation = f"{own if own.is_file() else recording.parent.parent / 'naive.py'}:{name}"
    return Known(f"{place.name} {folder} {recording.stem} {name}", recording, simulation, expected, between or {})
