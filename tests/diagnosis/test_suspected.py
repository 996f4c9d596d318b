"""Suspected sets of effects are scored next to the findings, and do not change the search."""

import functools
import json

import pytest
import torch

pytest.importorskip("jsonschema")

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.decisions import ScoredModel, Trail
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.model.suspect import suspected_terms
from mkc_torch.diagnosis.parts import EffectParameter
from mkc_torch.diagnosis.suspected_sentences import suspected_sentences
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Static
from tests.diagnosis.factory import make_diagnosis, make_environment
from tests.diagnosis.swing import Pendulum, candidates, fitted_pendulum, pendulum_recording

EFFECTS = tuple(e for e in DYNAMICS if e.id in ("quadratic_drag", "linear_drag", "coulomb_friction", "input_lag"))
OPTIONS = {"effects": EFFECTS, "surrogates": 19, "input_hold": {"torque": "held"}, "quick": True}
DRAG, OTHER = "quadratic_drag@rate", "coulomb_friction@rate + input_lag@torque"

ALONE = ScoredModel((), "", 800.0, {"log_likelihood": 800.0}, "white", {"angle": 0.02})
FOUND = ScoredModel((DRAG,), f"add {DRAG}", 850.0, {}, "white", {"angle": 0.004}, chosen=True)
SUSPECTED = ScoredModel(
    ("coulomb_friction@rate",),
    "suspected",
    837.7,
    {},
    "white",
    {"angle": 0.0139},
    suspected=True,
    parameters=((EffectParameter("friction", 0.31, 0.02, "rad/s²"),),),
)


@functools.cache
def quick_look(*suspect, max_findings=3):
    recording = pendulum_recording("none", 0, 300, 0.3)[0]
    return diagnose(Pendulum(), recording, suspect=suspect, max_findings=max_findings, **OPTIONS)


@pytest.mark.e2e
def test_the_search_is_the_same_with_and_without_a_suspicion():
    plain, suspicious = quick_look(), quick_look(DRAG, OTHER)
    assert plain.suspected == ()
    assert tuple(model for model in suspicious.decisions.models if not model.suspected) == plain.decisions.models
    assert suspicious.decisions.decisions == plain.decisions.decisions
    assert [finding.parameters for finding in suspicious.findings] == [f.parameters for f in plain.findings]


@pytest.mark.e2e
def test_a_suspected_set_is_reported_next_to_the_findings():
    diagnosis = quick_look(DRAG, OTHER)
    drag, other = [model for model in diagnosis.decisions.models if model.suspected]
    assert (drag.terms, other.terms) == ((DRAG,), ("coulomb_friction@rate", "input_lag@torque"))
    assert {model.move for model in (drag, other)} == {"suspected"}
    assert drag.open_loop["angle"] == pytest.approx(0.004, rel=0.15)
    assert drag.parameters[0][0].value == pytest.approx(0.3, abs=0.05)
    found, worse = diagnosis.suspected
    assert found.startswith(f"The suspected {DRAG} is what was found; it leaves 0.00")
    assert worse.startswith(f"The suspected {OTHER} scores ")
    assert "less than the findings" in worse
    content = json.loads(diagnosis_to_json(diagnosis))
    assert content["suspected"] == list(diagnosis.suspected)
    assert content["decisions"]["models"][-2]["parameters"][0][0]["name"] == "drag"


@pytest.mark.e2e
def test_a_suspicion_is_scored_without_a_search():
    diagnosis = quick_look(DRAG, max_findings=0)
    assert diagnosis.findings == ()
    assert [model.terms for model in diagnosis.decisions.models] == [(), (DRAG,)]
    assert "more than the simulation alone" in diagnosis.suspected[0]


@pytest.mark.e2e
def test_the_terms_of_the_trail_are_suspects():
    fit = fitted_pendulum().fit
    terms = candidates(fit, EFFECTS)
    models = quick_look().decisions.models
    assert [len(model.terms) for model in models[:2]] == [0, 1]  # the simulation alone comes first
    for name in {name for model in models for name in model.terms}:
        (group,) = suspected_terms(name, terms, fit.model.prepared)
        assert len({term.key for term in group}) == 1


@pytest.mark.parametrize(
    ("suspect", "error", "words"),
    [
        ("quadratic_dragg@rate", ValueError, "did you mean `quadratic_drag`"),
        (["quadratic_drag@rate", "input_lag@force"], ValueError, "its ports in Pendulum are `torque`"),
        ("", ValueError, "joined by +"),
        (3, TypeError, "a text or a sequence of texts but got 3"),
        ([3], TypeError, r"`suspect\[0\]`"),
    ],
)
def test_an_unknown_suspicion_is_refused_before_the_first_fit(suspect, error, words):
    stages = []
    with pytest.raises(error, match=words.replace("+", r"\+")):
        diagnose(Pendulum(), pendulum_recording()[0], suspect=suspect, progress=stages.append, **OPTIONS)
    assert set(stages) <= {"reading the recording"}


def test_a_suspicion_needs_differential_equations():
    time = torch.arange(60) / 10.0
    recording = Recording({"time": time, "heat": torch.sin(time), "voltage": 0.5 + torch.sin(time)})
    line = Static(torch.nn.Linear(1, 1), inputs=("heat",), outputs=("voltage",))
    with pytest.raises(ValueError, match="differential equations only and Linear has none, but got 'gain'"):
        diagnose(line, recording, suspect="gain")


def test_a_suspected_set_is_compared_with_the_findings_or_with_the_simulation_alone():
    def sentence(model, *, findings=True):
        return suspected_sentences(Trail((ALONE, FOUND, model)), {"angle": "rad"}, findings=findings)[0]

    name = "The suspected coulomb_friction@rate"
    sizes = "Its sizes: friction 0.31 rad/s² of coulomb_friction@rate."
    assert sentence(SUSPECTED) == f"{name} scores 12.3 less than the findings; it leaves 0.0139 rad. {sizes}"
    assert sentence(SUSPECTED, findings=False).startswith(f"{name} scores 37.7 more than the simulation alone;")
    lost = ScoredModel(SUSPECTED.terms, "suspected", None, {}, "", {}, suspected=True)
    assert sentence(lost) == f"{name} has no score: no fit with it follows the recording."
    runaway = ScoredModel(SUSPECTED.terms, "suspected", 881.0, {}, "white", {}, suspected=True)
    expected = f"{name} scores 31 more than the findings; its open-loop simulation loses the recording."
    assert sentence(runaway) == expected
    assert suspected_sentences(Trail((ALONE, FOUND)), {}, findings=True) == ()


def test_several_outputs_are_named():
    model = ScoredModel((DRAG,), "suspected", 800.0, {}, "white", {"angle": 0.01, "rate": 0.2}, suspected=True)
    (sentence,) = suspected_sentences(Trail((ALONE, model)), {"angle": "rad", "rate": "rad/s"}, findings=False)
    expected = f"The suspected {DRAG} scores as much as the simulation alone; "
    assert sentence == f"{expected}it leaves 0.01 rad of angle, 0.2 rad/s of rate."


def test_the_page_has_the_sentence():
    pytest.importorskip("jinja2")
    from mkc_torch.report import diagnosis_report

    diagnosis = make_diagnosis(0, environment=make_environment(), decisions=Trail((ALONE, SUSPECTED)))
    page = diagnosis_report(diagnosis)
    assert "The suspected coulomb_friction@rate scores 37.7 more than the simulation alone" in page
    assert "<strong>suspected</strong>" in page
