"""The contract of every test of evidence in the registry."""

import json
import re
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.evidence import TESTS
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, EvidenceTest
from mkc_torch.diagnosis.evidence.held_out import blocks_of, held_out
from mkc_torch.diagnosis.evidence.run import precompute, results_of_tests
from mkc_torch.diagnosis.findings.warnings import evidence_warnings
from mkc_torch.diagnosis.io.diagnosis_json import _json, json_schema
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.stepwise import first_step, next_step
from mkc_torch.diagnosis.settings import ConfirmationSettings, DriverSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.report.diagnosis.evidence import rows, tables
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.line import Line
from tests.simulation.tumbling import tumbling

N = 1500
TIME = np.arange(N) / 50.0


def without_findings():
    line = Line(300)
    base = fitted(JointModel(line), line.start())
    blocks = blocks_of(300, 1, ConfirmationSettings())
    return EvidenceContext(base, None, (), (held_out(base, blocks),), blocks, (), 0, Settings())


def with_findings():
    """Return a case with two findings: the field of a current, and a step."""
    current = np.sin(2.0 * np.pi * TIME / 3.7) + 0.4 * np.sin(2.0 * np.pi * TIME / 0.83)
    sensor = np.outer(current, [0.9, -0.8, 0.9]) + np.outer(TIME >= 14.0, [3.0, 2.0, -3.0])
    simulation = Magnetometer("norm")
    prepared = simulation.prepare(tumbling(N, noise=0.3, sensor=sensor, current=current))
    effects = [effect for effect in CATALOGUE if effect.id in ("current_field", "hard_iron_step")]
    roles = frozenset(role for effect in effects for role in effect.roles)
    drivers = find_drivers(prepared.recording, simulation.columns, DriverSettings(), roles).drivers
    base = fitted(JointModel(prepared), prepared.start())
    asked, generator = SearchOptions(0.05, 19, 2, 0, Settings()), torch.Generator().manual_seed(0)
    search = first_step(base, candidate_terms(prepared, drivers, effects), asked, generator)
    search = next_step(search, asked, generator)
    assert len(search.found) == 2
    return EvidenceContext(base, search.first, search.found, search.evidence, search.blocks, drivers, 0, Settings())


@pytest.fixture(scope="module", params=[without_findings, pytest.param(with_findings, marks=pytest.mark.e2e)])
def case(request):
    return request.param()


@pytest.fixture(scope="module")
def precomputed(case):
    return [work() for work in precompute(case)]


@pytest.fixture(scope="module")
def report(case, precomputed):
    return results_of_tests(case, precomputed)


def all_results(report):
    return [*report.of_all, *(said for each in report.of_findings for said in each)]


def tensors(value, seen):
    """Yield all tensors that are reachable from a value."""
    if id(value) in seen:
        return
    seen[id(value)] = value
    if isinstance(value, torch.Tensor):
        yield value
    elif is_dataclass(value):
        for field in fields(value):
            yield from tensors(getattr(value, field.name), seen)
    elif isinstance(value, dict):
        yield from tensors(list(value.values()), seen)
    elif isinstance(value, (list, tuple)):
        for child in value:
            yield from tensors(child, seen)
    elif hasattr(value, "__dict__"):
        yield from tensors(vars(value), seen)


def test_each_test_runs_for_the_diagnosis_or_for_each_finding(report):
    for_findings = sum(test.each_finding for test in TESTS)
    assert len(report.of_all) == len(TESTS) - for_findings
    assert all(len(said) == for_findings for said in report.of_findings)
    assert len(report.of_findings) == len(report.case.found)


def test_test_ids_are_unique_identifiers(report):
    for said in (report.of_all, *report.of_findings):
        ids = [result.test for result in said]
        assert len(set(ids)) == len(ids)
        assert all(re.fullmatch("[a-z][a-z0-9_]*", one) for one in ids)


def test_results_are_json_under_keys_of_the_schema(report):
    for result in all_results(report):
        json.dumps(_json([result.content, result.keys]), allow_nan=False)
    schema = json_schema()
    assert {key for result in report.of_all for key in result.keys} <= set(schema["properties"])
    of_findings = {key for said in report.of_findings for result in said for key in result.keys}
    assert of_findings <= set(schema["$defs"]["finding"]["properties"])


def test_warnings_are_sentences_and_rows_are_not(report):
    assert all(w[0].isupper() and w.endswith(".") for w in evidence_warnings(report) if "_" not in w)
    assert all(label and text and not text.endswith(".") for label, text in rows(all_results(report)))
    for table in tables(all_results(report)):
        assert all(len(cells) == len(table.columns) for cells in table.rows)
        assert not table.note or table.note.endswith(".")


def test_results_and_warnings_are_in_the_order_of_the_tests(report):
    of_all, of_findings = iter(report.of_all), [iter(results) for results in report.of_findings]
    expected = [next(each) for test in TESTS for each in (of_findings if test.each_finding else [of_all])]
    assert [result for _, result in report.results] == expected
    assert list(evidence_warnings(report)) == [
        warning for pair in report.results for warning in evidence_warnings(replace(report, results=(pair,)))
    ]


def test_tests_change_neither_their_inputs_nor_the_global_random_state(case, precomputed, report):
    before = [(tensor, tensor.clone()) for tensor in tensors((case, precomputed), {})]
    random = torch.random.get_rng_state()
    again = results_of_tests(case, precomputed)
    assert rows(all_results(again)) == rows(all_results(report))
    assert [_json(result.keys) for result in all_results(again)] == [
        _json(result.keys) for result in all_results(report)
    ]
    assert evidence_warnings(again) == evidence_warnings(report)
    assert torch.equal(torch.random.get_rng_state(), random)
    assert before
    assert all(torch.equal(item, copy) for item, copy in before)


def test_results_do_not_depend_on_the_order_of_precomputation(case, report):
    works = precompute(case)
    backwards = [work() for work in reversed(works)][::-1]
    again = results_of_tests(case, backwards)
    assert [_json([result.content, result.keys]) for result in all_results(again)] == [
        _json([result.content, result.keys]) for result in all_results(report)
    ]


def test_a_test_has_its_precomputed_value_and_the_final_parameters(case):
    def ahead(case):
        with pytest.raises(AssertionError):
            case.final
        return case.seed, case.number

    def test(case):
        return EvidenceResult("mine", (case.ahead, case.number, float(case.final.fit.residual.sum())))

    mine = [EvidenceTest(test, ahead), EvidenceTest(test, ahead, each_finding=True), EvidenceTest(test)]
    works = precompute(replace(case, seed=3), mine)
    answers = results_of_tests(replace(case, seed=3), [work() for work in works], mine)
    assert [result.value[:2] for result in answers.of_all] == [((3, 0), 0), (None, 0)]
    assert [result.value[:2] for (result,) in answers.of_findings] == [((3, k), k) for k in range(len(case.found))]
