"""Each sentence of advice is stated where it is true, and is not stated where it would be false."""

import ast
import dataclasses
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest

import mkc_torch
from mkc_torch.diagnosis import vetoes
from mkc_torch.diagnosis.decisions import Decision, Trail
from mkc_torch.diagnosis.environment import Offset
from mkc_torch.diagnosis.evidence import prediction, timing
from mkc_torch.diagnosis.findings.advice import SAME, advice_of
from mkc_torch.diagnosis.findings.noise import shared_offsets
from mkc_torch.diagnosis.findings.warnings import proxy_driver_warnings, rejected_warnings, remaining_warnings
from mkc_torch.diagnosis.pipeline.search_notes import with_search_notes
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.result import Alternative, Diagnosis, HeldOut, Stop, notices
from mkc_torch.recording.disturbance import RejectedInterval
from mkc_torch.report.diagnosis.verdict import RunPaths, apply_command
from tests.diagnosis.cart import first_term, free_fit
from tests.diagnosis.factory import (
    PROCESS_NOISE,
    make_diagnosis,
    make_environment,
    make_unfit,
    with_another_shape,
    with_evidence,
)


def one(**changes):
    """Return a diagnosis of one finding, without alternatives, with some of the finding's fields changed."""
    made = make_diagnosis(1, samples=60)
    first = dataclasses.replace(made.findings[0], **({"alternatives": ()} | changes))
    return dataclasses.replace(made, findings=(first,), verdict="unexplained" if "grade" in changes else made.verdict)


def held(*numbers, **more):
    """Return a diagnosis of one finding, graded by this evidence on held-out blocks."""
    made = one()
    evidence = prediction.held_out_gain_result(HeldOut(*numbers, "µT", **more), "")
    first = with_evidence(made.findings[0], evidence)
    verdict = "unexplained" if first.grade == "unconfirmed" else "explained"
    return dataclasses.replace(made, findings=(first,), verdict=verdict)


def failed(rule, sentence="", **changes):
    """Return a diagnosis without findings in whose trail this rule fails."""
    trail = Trail(decisions=(Decision(rule, "", 1.0, 0.5, False, sentence),))
    return make_diagnosis(0, samples=60, decisions=trail, **({"verdict": "unexplained"} | changes))


def much_rejected(share):
    made = make_diagnosis(0, samples=60)
    weight = made.traces.weight.clone()
    weight[:] = 0.9
    weight[: int(share * len(weight))] = 0.1
    return dataclasses.replace(made, traces=dataclasses.replace(made.traces, weight=weight))


def not_better(ratio):
    made = one()
    corrected = dataclasses.replace(made.corrected, rmse=ratio * made.baseline.rmse)
    return dataclasses.replace(made, corrected=corrected)


def disturbed(**changes):
    noise = dataclasses.replace(PROCESS_NOISE, **changes)
    return make_diagnosis(0, samples=60, verdict="unexplained", environment=make_environment(process_noise=(noise,)))


def quiet():
    return make_diagnosis(0, samples=60)


def rival(**changes):
    return Alternative("offset_drift", (), 0.4, **({"separable": False} | changes))


class Advice(NamedTuple):
    """A sentence of advice, a diagnosis in which it is true, and one in which it would be false."""

    sentence: str
    true: Callable[[], Diagnosis]
    false: Callable[[], Diagnosis]


STOP = Stop("time limit", 60.0, ("the search for effects",))
ADVICE = (
    Advice(
        "Complete the search", lambda: failed("stopped", stop=STOP), lambda: make_diagnosis(0, verdict="unexplained")
    ),
    Advice("Do not rely on this simulation yet: check the reasons", make_unfit, quiet),
    Advice(
        "Do not rely on this simulation yet: check signs, units, delays and start values",
        lambda: make_unfit(environment=make_environment(reasons=())),
        make_unfit,
    ),
    Advice("Record longer, or more runs: 20 samples", lambda: failed("enough_samples", "20 samples."), quiet),
    Advice(
        "check signs and units first",
        lambda: failed("simulation_explains_more", "The correction 60 %: check signs and units first."),
        lambda: failed("structure_left", "A trend remains."),
    ),
    Advice("Confirm this by a full diagnosis", lambda: dataclasses.replace(one(), quick=True), one),
    Advice("The simulation can be used within the range", quiet, lambda: make_diagnosis(0, verdict="unexplained")),
    Advice("The simulation can be used within the range", lambda: much_rejected(0.2), lambda: much_rejected(0.5)),
    Advice("Find out why so many samples were rejected", lambda: much_rejected(0.5), lambda: much_rejected(0.2)),
    Advice("The model found here corrects for", one, lambda: one(location_specific=True)),
    Advice("The model found here corrects for", lambda: not_better(0.6), lambda: not_better(1.1)),
    Advice("Do not apply the model found here", lambda: not_better(1.1), lambda: not_better(0.6)),
    Advice(
        "Look for other causes that vary with load",
        lambda: make_diagnosis(0, samples=60, remaining=("load",)),
        lambda: make_diagnosis(0, samples=60, verdict="unexplained"),
    ),
    Advice("Look for the cause of the disturbance of the rate", disturbed, lambda: disturbed(at_rate=False)),
    Advice("Look for a cause of the drift", lambda: disturbed(at_rate=False), disturbed),
    Advice(
        "such as warming up",
        lambda: disturbed(at_rate=False, correlation_time=300.0),
        lambda: disturbed(at_rate=False, correlation_time=3.0),
    ),
    Advice("with more columns that could explain the residual", lambda: failed("structure_left"), quiet),
    Advice(
        "unless means over many samples matter: it reduces the residual by only 2.3 %",
        lambda: held(0.05, (0.03, 0.07), 1.74, 1.70),
        lambda: held(0.31, (0.28, 0.35), 0.9, 0.5),
    ),
    Advice(
        "Look for other physics at the same port",
        lambda: one(cannot_be=True, plausible=False, grade="unconfirmed", plausibility="Its share ended at a bound."),
        one,
    ),
    Advice(
        "yet: held-out blocks do not confirm it",
        lambda: held(0.13, (-0.4, 0.66), 1.0, 0.99),
        lambda: held(0.31, (0.28, 0.35), 0.9, 0.5),
    ),
    Advice(
        "yet: the open-loop residual on held-out blocks is not clearly smaller with it",
        lambda: held(0.3, (0.2, 0.4), 1.0, 1.2, decides=False),
        lambda: held(0.3, (0.2, 0.4), 1.0, 0.7, decides=False),
    ),
    Advice(
        "yet: the compared length hardly shows it",
        lambda: one(shown_share=0.001, grade="unconfirmed"),
        lambda: one(shown_share=0.9),
    ),
    Advice(
        "yet: held-out blocks do not confirm it",
        lambda: held(0.13, (-0.4, 0.66), 1.0, 0.99),
        lambda: one(shown_share=0.001, grade="unconfirmed"),
    ),
    Advice("its p-value is above the level", lambda: one(p_value=0.3, grade="unconfirmed"), one),
    Advice("it was not tested on held-out blocks", lambda: one(evidence=(), grade="unconfirmed", p_value=None), one),
    Advice("is not plausible: look for another cause", lambda: one(plausible=False), one),
    Advice("To distinguish", lambda: one(alternatives=(rival(),)), lambda: one(alternatives=(rival(separable=True),))),
    Advice(
        SAME,
        lambda: one(alternatives=(rival(distinguishing_state=SAME),)),
        lambda: one(alternatives=(rival(distinguishing_state="In a similar recording, more samples would."),)),
    ),
    Advice("If it is hard_iron_step:", lambda: one(alternatives=(rival(),)), one),
    Advice(
        "switched on and off",
        lambda: dataclasses.replace(
            one(), findings=(with_evidence(one().findings[0], timing.intermittency_result(True)),)
        ),
        one,
    ),
    Advice(
        "the recording shows another shape",
        lambda: dataclasses.replace(one(), findings=(with_another_shape(one().findings[0]),)),
        one,
    ),
)


@pytest.mark.parametrize("advice", ADVICE, ids=lambda advice: advice.sentence[:40])
def test_advice_is_stated_where_it_is_true_and_only_there(advice):
    assert advice.sentence in " ".join(advice_of(advice.true()))
    assert advice.sentence not in " ".join(advice_of(advice.false()))


def test_each_grade_that_is_held_back_has_its_own_reason():
    """The reason is that of a failed veto, whatever the wording."""
    for advice in ADVICE:
        for finding in advice.true().findings:
            if finding.grade == "unconfirmed" and not finding.cannot_be:
                broken = {decision.rule for decision in vetoes.decisions_on(finding) if not decision.passed}
                assert ("held_out_blocks" in broken) == ("held-out blocks do not" in vetoes.refusal(finding))


def search(**fields):
    first = {"first": None, "found": (), "unconfirmed": None, "blocks": None, "evidence": (), "left": ()}
    return StepwiseSearch(**first | fields)


def hinted(p_value, longer=3.0):
    term = first_term(free_fit(), "quadratic_drag")
    return search(first=SimpleNamespace(term=term, p_value=p_value, follow=(), longer=longer))


@pytest.mark.parametrize(
    ("sentence", "true", "false"),
    [
        ("raise `--max-findings`", search(cut=True), search()),
        ("about 3 times as long would decide", hinted(0.09), hinted(0.4)),
        ("times as long would decide", hinted(0.09), hinted(0.09, longer=float("inf"))),
    ],
)
def test_a_remedy_of_the_search_is_stated_only_where_it_helps(sentence, true, false):
    diagnosis = make_diagnosis(0, samples=60, verdict="unexplained")
    assert sentence in " ".join(with_search_notes(diagnosis, true).warnings)
    assert sentence not in " ".join(with_search_notes(diagnosis, false).warnings)


def test_notices_state_what_was_left_out_and_only_then():
    assert notices(None, quick=False) == ()
    (quick,) = notices(None, quick=True)
    assert "Leave out --quick" in quick
    stopped, few = notices(STOP, quick=False, too_few=True)
    assert "not done: the search for effects" in stopped
    assert "Record longer, or add runs" in few


def test_warnings_without_their_cause_are_not_stated():
    assert "vary" not in "".join(remaining_warnings(()))
    assert "smooth trend along load" in remaining_warnings(("load",))[0]
    assert rejected_warnings(()) == ()
    assert "from 1.0 to 3.0 s" in rejected_warnings([RejectedInterval(1.0, 3.0)])[0]
    assert "load may be a proxy" in proxy_driver_warnings(("load",))[0]


def test_an_offset_that_differs_between_recordings_is_no_property_of_the_simulation():
    same = [Offset("lift", "rad", k, f"{k}.csv", 0.037, 0.001) for k in (1, 2)]
    assert "Look for a cause that does not change" in shared_offsets(same)[0]
    assert shared_offsets([same[0], dataclasses.replace(same[1], value=-0.02)]) == ()


OF_OTHER_PROGRAMS = {"--ros-args", "--params-file", "--pre", "--no-deps"}
"""Options in messages that are no options of this command."""


def strings_of(path):
    """Yield the string constants of a file, without docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    bodies = [node.body for node in ast.walk(tree) if isinstance(node, documented)]
    alone = [item for body in bodies for item in body if isinstance(item, ast.Expr)]
    comments = {id(item.value) for item in alone if isinstance(item.value, ast.Constant)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in comments:
            yield node.value


def options_of_commands():
    """Return the options of each command."""
    typer = pytest.importorskip("typer")
    from mkc_torch.cli.app import app

    group = typer.main.get_command(app)
    return {
        name: {option for parameter in command.params for option in parameter.opts if option.startswith("--")}
        for name, command in group.commands.items()
    }


def named_options(folder):
    """Return each option that a message of a folder names, with the file."""
    root = Path(mkc_torch.__file__).parent
    return {
        (option, str(path.relative_to(root)))
        for path in sorted((root / folder).rglob("*.py"))
        for text in strings_of(path)
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)
    }


@pytest.mark.parametrize(
    ("folder", "commands"),
    [
        ("diagnosis", ("diagnose", "apply", "check")),
        ("report/diagnosis", ("diagnose", "apply")),
        ("recording", ("diagnose", "calibrate", "apply", "check", "inspect")),
        ("simulation", ("diagnose", "apply", "check")),
        ("calibration", ("calibrate", "export", "apply")),
    ],
)
def test_each_option_that_a_message_names_is_one_of_the_command(folder, commands):
    known = options_of_commands()
    there = set().union(*(known[name] for name in commands))
    named = named_options(folder)
    assert {option for option, _ in named if option not in there | OF_OTHER_PROGRAMS} == set(), named


def test_each_option_that_any_message_names_exists():
    known = set().union(*options_of_commands().values(), {"--version"})
    assert {option for option, _ in named_options("") if option not in known | OF_OTHER_PROGRAMS} == set()


def test_the_proposed_command_has_options_of_apply_only():
    from mkc_torch.cli.units_option import reading_options

    read_with = reading_options({"mag_x": "mx", "experiment": "run"}, ["mag=gauss"], "counts", "COMPASS2")
    paths = RunPaths("a.csv", "model.json", ("--simulation", "a.py:A", "--simulator-output", "s.csv", *read_with))
    for found in (
        one(),
        dataclasses.replace(one(), simulation="simulated"),
        dataclasses.replace(one(), simulation="A"),
    ):
        for given in (paths, None):
            program, name, *arguments = shlex.split(apply_command(found, given))
            named = {argument for argument in arguments if argument.startswith("--")}
            assert (program, name) == ("mkc", "apply")
            assert named
            assert named <= options_of_commands()["apply"]


def test_the_advice_of_a_diagnosis_names_options_of_diagnose():
    known = options_of_commands()
    for path in ("pipeline/search_notes.py", "findings/advice.py", "findings/warnings.py", "result.py", "verdict.py"):
        named = {option for option, file in named_options("diagnosis") if file == f"diagnosis/{path}"}
        assert named <= known["diagnose"]
