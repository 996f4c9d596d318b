"""Settings: each number is documented, used, and checked."""

import ast
import importlib
import inspect
import re
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import mkc_torch.diagnosis
from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis import Settings
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import (
    ConfirmationSettings,
    DriverSettings,
    EvidenceSettings,
    NamingSettings,
    NoiseSettings,
    SearchSettings,
)
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.pipeline.test_stepwise import BLOCKS, NOTHING, evidence, located
from tests.simulation.tumbling import tumbling

ROOT = Path(mkc_torch.diagnosis.__file__).parent
SOURCES = sorted(ROOT.rglob("*.py"))
STAGES = [field.default.__class__ for field in fields(Settings)]
holds = importlib.import_module("mkc_torch.diagnosis.pipeline.stepwise")._holds


def is_number(node):
    """Whether an expression is a literal number, or a sequence of literal numbers."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
    if isinstance(node, (ast.Tuple, ast.List)):
        return bool(node.elts) and all(is_number(element) for element in node.elts)
    if isinstance(node, ast.BinOp):
        return is_number(node.left) and is_number(node.right)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func).startswith("math.") and all(is_number(argument) for argument in node.args)
    return isinstance(node, ast.UnaryOp) and is_number(node.operand)


def undocumented(source):
    """Yield module-level assignments of numbers without a docstring or comment."""
    lines, body = source.splitlines(), ast.parse(source).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None or not is_number(node.value):
            continue
        documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        noted = "#" in lines[node.lineno - 1] or lines[max(node.lineno - 2, 0)].startswith("#")
        if not documented and not noted:
            yield ast.unparse(node)


def test_every_number_is_documented():
    assert {
        path.name: found for path in SOURCES if (found := list(undocumented(path.read_text(encoding="utf-8"))))
    } == {}


def test_an_undocumented_number_is_detected():
    source = 'A = 1.0\n"""Said."""\n\n# said\nB = -2\nC, D = 3, 4\nE = 2.0 * math.log(3.0)\nF = 5  # said\nG = "text"\n'
    assert list(undocumented(source)) == ["C, D = (3, 4)", "E = 2.0 * math.log(3.0)"]


@pytest.mark.parametrize("stage", [Settings, *STAGES])
def test_every_setting_is_documented(stage):
    documented = re.findall(r"^    (\w+): ", inspect.getdoc(stage).partition("Attributes:")[2], re.MULTILINE)
    assert documented == [field.name for field in fields(stage)]


@pytest.mark.parametrize("stage", STAGES)
def test_every_setting_is_used(stage):
    sources = [path for path in SOURCES if path.name != "settings.py"]
    nodes = [node for path in sources for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    used = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    assert {field.name for field in fields(stage)} <= used


def test_settings_are_immutable_and_compare_by_value():
    changed = replace(Settings(), naming=NamingSettings(separable=8.0))
    assert Settings() == Settings()
    assert hash(Settings()) == hash(Settings())
    assert changed != Settings()
    assert changed.noise == Settings().noise
    with pytest.raises(FrozenInstanceError):
        changed.naming.separable = 4.5


@pytest.mark.parametrize(
    ("make", "error", "sentence"),
    [
        (lambda: NamingSettings(separable="wide"), TypeError, "`separable`.*number.*'wide'; 4.5 is usual"),
        (lambda: NamingSettings(separable=-1.0), ValueError, "`separable`.*got -1.0; 4.5 is usual"),
        (lambda: NamingSettings(kept=float("nan")), ValueError, "`kept`.*got nan; 0.8 is usual"),
        (lambda: SearchSettings(refitted=0), ValueError, "`refitted`.*at least 1 but got 0; 6 is usual"),
        (lambda: SearchSettings(parts=1.5), ValueError, "`parts`.*whole number.*got 1.5; 2 is usual"),
        (lambda: ConfirmationSettings(folds=2), ValueError, "`folds`.*at least 3 but got 2; 5 are usual"),
        (lambda: ConfirmationSettings(unrecorded=0.0), ValueError, "`unrecorded`.*got 0.0; 0.1 is usual"),
        (lambda: NoiseSettings(plateaus=((0.0, 1.0),)), ValueError, "`plateaus`.*got 0.0; .* is usual"),
        (lambda: Settings(noise=NamingSettings()), TypeError, "`noise` to be NoiseSettings.*pass NoiseSett"),
    ],
)
def test_invalid_numbers_raise(make, error, sentence):
    with pytest.raises(error, match=sentence):
        make()


N = 400
TIME = np.arange(N) / 50.0
CAUSE = np.sin(2.0 * np.pi * TIME / 3.7) + 0.4 * np.sin(2.0 * np.pi * TIME / 0.83)
CURRENT = CAUSE + 0.25 * np.random.default_rng(3).standard_normal(N) + 2.0
EFFECTS = [effect for effect in CATALOGUE if effect.id in ("current_field", "driver_offset")]


def diagnosis(settings):
    """Diagnose a sensor that depends on a column of unknown role, which correlates with a known driver."""
    recording = tumbling(N, noise=0.3, sensor=np.outer(CAUSE, [0.9, -0.8, 0.9]), current=CURRENT, load=CAUSE)
    return diagnose(Magnetometer("norm"), recording, effects=EFFECTS, surrogates=19, max_findings=1, settings=settings)


@pytest.fixture(scope="module")
def diagnosis_with_default_settings():
    return diagnosis(Settings())


@pytest.mark.parametrize("other", ["strict", None, Settings, NamingSettings(), {"separable": 8.0}])
def test_other_types_than_settings_raise(other):
    with pytest.raises(TypeError, match=r"`settings`.*Settings.*Settings\("):
        diagnosis(other)


@pytest.mark.e2e
def test_the_known_driver_is_named_and_separable_from_the_column(diagnosis_with_default_settings):
    (finding,) = diagnosis_with_default_settings.findings
    (rival,) = finding.alternatives
    assert (finding.effect, rival.effect, rival.separable) == ("current_field", "driver_offset", True)


@pytest.mark.e2e
def test_without_its_penalty_the_column_is_named():
    (finding,) = diagnosis(Settings(naming=NamingSettings(roleless=0.0, follower=0.0))).findings
    assert finding.effect == "driver_offset"


@pytest.mark.e2e
def test_rivals_within_separable_are_inseparable(diagnosis_with_default_settings):
    far = 2.0 * diagnosis_with_default_settings.findings[0].alternatives[0].log_likelihood_gap
    (finding,) = diagnosis(Settings(naming=NamingSettings(separable=far))).findings
    assert (finding.effect, finding.alternatives[0].separable) == ("current_field", False)
    assert finding.alternatives[0].distinguishing_state


@pytest.mark.e2e
def test_remaining_gain_is_the_limit_of_the_warning(diagnosis_with_default_settings):
    warned = [warning for warning in diagnosis_with_default_settings.warnings if "smooth trend along load" in warning]
    assert len(warned) == 1
    quiet = diagnosis(Settings(evidence=EvidenceSettings(remaining_gain=100.0)))
    assert not set(warned) & set(quiet.warnings)
    assert (diagnosis_with_default_settings.verdict, quiet.verdict) == ("unexplained", "explained")


@pytest.mark.e2e
def test_folds_change_the_held_out_evidence(diagnosis_with_default_settings):
    held_out = diagnosis(Settings(confirmation=ConfirmationSettings(folds=3))).findings[0].held_out
    assert held_out.log_likelihood_gain != diagnosis_with_default_settings.findings[0].held_out.log_likelihood_gain


@pytest.mark.e2e
def test_rejected_below_changes_the_gains(diagnosis_with_default_settings):
    rejecting = diagnosis(Settings(noise=NoiseSettings(rejected_below=0.8)))
    assert (
        rejecting.candidates[0].log_likelihood_gain != diagnosis_with_default_settings.candidates[0].log_likelihood_gain
    )


def test_a_recording_shorter_than_fewest_samples_is_not_tested():
    result = diagnosis(Settings(search=SearchSettings(fewest_samples=500)))
    assert result.too_few
    assert result.findings == ()
    assert result.p_value is None
    assert result.candidates


def test_a_column_below_fewest_finite_is_left_out():
    time, load = torch.from_numpy(TIME), torch.from_numpy(np.where(np.arange(N) % 5 == 0, np.nan, CAUSE))
    recording, taken = Recording({"time": time, "load": load}), frozenset({"time"})
    assert len(find_drivers(recording, taken, DriverSettings()).drivers) == 1
    found = find_drivers(recording, taken, DriverSettings(fewest_finite=0.9))
    (warning,) = found.warnings
    assert found.drivers == ()
    assert "`load` has only 80% finite values" in warning


@pytest.mark.parametrize(
    ("first", "beyond", "changed"),
    [(True, 100.0, {"beyond_doubt": 200.0}), (False, 100.0, {"further": 200.0})],
)
def test_beyond_doubt_and_further_are_limits(first, beyond, changed):
    after = evidence(-0.01 if first else 0.01, 1.0)
    assert holds(located(beyond), NOTHING, after, BLOCKS, 0, ConfirmationSettings(), first=first)
    assert not holds(located(beyond), NOTHING, after, BLOCKS, 0, ConfirmationSettings(**changed), first=first)
