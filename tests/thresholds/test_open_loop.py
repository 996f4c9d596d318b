"""The draws that thresholds are set on hide what their names say, and error rates are counted per recording."""

import pytest
import torch

from tests.thresholds.open_loop import NOTHING, SYSTEMS, drawn, rates, search_statistics


@pytest.mark.parametrize("name", list(SYSTEMS))
def test_the_same_seed_gives_the_same_recording_and_each_effect_its_own(name):
    simulation, _, _, effects = SYSTEMS[name]
    output = simulation.outputs[0]
    first, again = drawn(name, effects[0], 3), drawn(name, effects[0], 3)
    torch.testing.assert_close(first[output], again[output], rtol=0, atol=0)
    assert len({float(drawn(name, hidden, 3)[output][9]) for hidden in (*effects, NOTHING)}) == len(effects) + 1
    assert set(first.names) == {"time", output, *simulation.inputs}


def test_error_rates_count_recordings():
    def candidate(ratio, right):
        return {"effect": "drag" if right else "lag", "ratio": ratio, "gain": 5.0, "right": right}

    rows = [
        {"hidden": "drag", "claimed": "drag", "models": [candidate(0.4, True)]},
        {"hidden": "drag", "claimed": "lag", "models": [candidate(0.2, False), candidate(0.8, True)]},
        {"hidden": NOTHING, "claimed": NOTHING, "models": [candidate(0.6, False), candidate(0.3, False)]},
    ]
    lines = list(rates(rows))
    assert "ratio 0.7: by chance below 1/1; hidden effect not below 1/2, as most likely candidate 0/1" in lines[2]
    assert "wrong most likely candidate not below 0/1" in lines[2]
    assert "gain 4.5: by chance above 1/1, hidden effect not above 0/2" in lines
    assert lines[-1] == "highest score: hidden effect 1/2; an effect by chance 0/1"


@pytest.mark.e2e
def test_a_search_returns_the_statistics_of_its_models():
    row = search_statistics("ship", "quadratic_drag", 0)
    assert row["claimed"] in {NOTHING, *(model["effect"] for model in row["models"])}
    assert any(model["right"] for model in row["models"])
    scores = [model["score"] for model in row["models"]]
    assert scores == sorted(scores, reverse=True)
