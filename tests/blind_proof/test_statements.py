import pytest

from examples.blind_proof.statements import driven_state

ANGLE, SPEED = {"size": 0.5, "standard_error": 0.4, "unit": "rad/s"}, {"size": 0.3, "standard_error": 0.01, "unit": ""}


@pytest.mark.parametrize(
    ("diagnosis", "state"),
    [
        (None, None),
        ({}, None),
        ({"noise": None, "findings": [], "disturbance": None}, None),
        ({"noise": {"process": {}}}, None),
        ({"noise": {"process": {"angle": ANGLE, "speed": SPEED}}}, "speed"),
        ({"noise": {"process": {"angle": ANGLE, "speed": SPEED}}, "disturbance": [{"state": "angle"}]}, "speed"),
        ({"noise": {"process": {"angle": {"size": 0.0, "standard_error": 0.1}}}, "disturbance": [{"state": "b"}]}, "b"),
        ({"noise": {"process": {"angle": {"size": 1.0, "standard_error": None}}}}, None),
        ({"noise": {"process": {"angle": {"size": "inf"}, "speed": None}}}, None),
        ({"noise": {"process": {"angle": ANGLE, "speed": {"size": float("nan"), "standard_error": 1.0}}}}, "angle"),
        ({"disturbance": [{}, {"state": "climb"}]}, "climb"),
        ({"disturbance": {"state": "climb"}}, None),
        ({"findings": [{"effect": "unknown", "channels": ["level", "rate of level"]}]}, "level"),
        ({"findings": [{"effect": "unknown", "state": "turn", "channels": ["rate of level"]}]}, "turn"),
        ({"findings": [{"effect": "unknown"}, {"channels": ["rate of level"]}]}, None),
    ],
)
def test_the_driven_state_is_read_from_incomplete_diagnoses(diagnosis, state):
    assert driven_state(diagnosis) == state
