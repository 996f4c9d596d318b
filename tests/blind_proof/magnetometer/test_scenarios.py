"""Each scenario of the magnetometer matches its name."""

import math

import pytest
import torch

from examples.blind_proof.draws import generator
from examples.blind_proof.key import canonical
from examples.blind_proof.magnetometer import rotation
from examples.blind_proof.magnetometer.motion import POSES, poses
from examples.blind_proof.magnetometer.noise import BURSTS, HEIGHT, axis_errors, bursts, draw_noise, drifting
from examples.blind_proof.magnetometer.scenarios import magnetometer_scenarios
from mkc_torch.simulation.load import load_simulation

SCENARIOS = {scenario.name: scenario for scenario in magnetometer_scenarios(30.0).scenarios}


def test_all_scenarios_are_listed():
    assert list(SCENARIOS) == ["white", "coloured", "wander", "bursts", "orientations", "useless"]
    assert [name for name, scenario in SCENARIOS.items() if not scenario.hides] == ["useless"]


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_same_address_gives_the_same_case_under_another_number(name):
    item, other = (SCENARIOS[name].draw(3, 1, False, number) for number in (1, 7))
    assert item.key.name == "case_00001"
    assert canonical([item.key]) == canonical([other.key]).replace("_00007", "_00001")
    for column, values in item.recording.columns.items():
        torch.testing.assert_close(other.recording[column], values, rtol=0, atol=0)
    elsewhere = SCENARIOS[name].draw(4, 1, False, 1).recording
    assert not torch.equal(elsewhere["mag_x"], item.recording["mag_x"])


@pytest.mark.parametrize("name", SCENARIOS)
def test_nothing_is_hidden_in_an_empty_case(name):
    for index in range(4):
        key = SCENARIOS[name].draw(3, index, False, index).key
        assert key.effects == ()
        assert key.kind == ("useless" if name == "useless" else "empty")
        assert bool(key.useless) == (name == "useless")
        assert (key.disturbance.kind if key.disturbance else "") == (name if name in ("wander", "bursts") else "")
        white = key.noise["kind"].startswith("white")
        assert white == (name != "coloured")
        assert (key.noise["walks"] is not None) == (name == "wander")
        assert (key.noise["attitude"] is not None) == (name == "coloured")


@pytest.mark.parametrize("name", ["white", "bursts"])
def test_the_offset_drifts_in_every_second_case_with_hidden_physics(name):
    keys = [SCENARIOS[name].draw(3, index, True, index).key for index in range(4)]
    assert [key.noise["walks"] is not None for key in keys] == [True, False, True, False]
    assert all(len(key.effects) == 1 for key in keys)
    assert all(key.effects[0].z > 0.0 for key in keys)


def test_a_drift_has_its_declared_size():
    noise = draw_noise(generator(1), 2000, 50.0)
    reach = []
    for seed in range(60):
        walking, far = drifting(generator(seed), noise, 2000)
        still = [process.sample(generator(seed, k), 2000) for k, process in enumerate(walking.walks)]
        reach += [float((path - path.mean()).square().mean().sqrt()) / noise.sigma / far for path in still]
    assert math.sqrt(sum(r * r for r in reach) / len(reach)) == pytest.approx(1.0, abs=0.12)
    # slow: its change from sample to sample is small compared with the noise
    steps = axis_errors(generator(2), walking, 2000).diff(dim=0)
    plain = axis_errors(generator(2), noise, 2000).diff(dim=0)
    assert float((steps - plain).std()) < 0.5 * float(plain.std())


def test_bursts_are_few_and_short_and_the_field_between_them_is_zero():
    field, mask = bursts(generator(3), 0.5, 1500, 0.02)
    assert not field[~mask].any()
    assert float(field[mask].norm(dim=-1).max()) >= 0.5 * HEIGHT[0] * 0.5
    starts = int((mask.int().diff(prepend=torch.zeros(1, dtype=torch.int32)) == 1).sum())
    assert 1 <= starts <= BURSTS[1]
    key = SCENARIOS["bursts"].draw(3, 1, False, 1).key
    assert key.disturbance.words["share"] < 0.25
    assert key.disturbance.words["share"] * 1500 <= len(key.outliers) + 1


def test_bursts_have_both_signs():
    """A one-sided pulse has a mean of 0.9 times its root mean square."""
    shares = []
    for seed in range(30):
        field, mask = bursts(generator(seed), 0.5, 4500, 0.02)
        shares.append(float(field[mask].mean(0).norm() / field[mask].square().sum(-1).mean().sqrt()))
    assert sorted(shares)[15] < 0.3


def test_a_sensor_rests_in_many_orientations_and_is_turned_between():
    motion = poses(generator(4), duration=60.0, rate=50.0)
    moves = (motion.gyro != 0.0).any(-1)
    assert 0.2 < float(moves.double().mean()) < 0.5
    begins = int((moves.int().diff() == 1).sum())
    assert POSES[0] - 1 <= begins <= POSES[1] - 1
    rests = motion.attitude[1:][~moves[1:] & ~moves[:-1]]
    assert len(torch.unique(rests.round(decimals=6), dim=0)) >= POSES[0] - 1
    # the attitude is the gyroscope's integral
    turn = rotation.product(motion.attitude[:-1] * torch.tensor([1.0, -1.0, -1.0, -1.0]), motion.attitude[1:])
    expected = rotation.from_vector(motion.gyro[:-1] / 50.0)
    torch.testing.assert_close(turn, expected, atol=1e-9, rtol=0)
    assert float(motion.rotation[..., 2].abs().max(0).values.min()) > 0.8


def test_unusable_views_are_requested_and_differ_from_the_truth(tmp_path):
    views = []
    for index in range(4):
        case = SCENARIOS["useless"].draw(3, index, False, index)
        names = case.recording.names
        views.append((case.key.useless, "gyro_x" in names, "q_w" in names))
        if case.simulation:
            path = tmp_path / f"{index}.py"
            path.write_text(case.simulation, encoding="utf-8")
            simulation = load_simulation(f"{path}:sensor")
            assert simulation.use == ("gyro" if "gyro" in case.key.useless else "attitude")
    assert views == [
        ("unrelated field", False, False),
        ("gyroscope of the wrong sign", True, False),
        ("gyroscope of another recording", True, False),
        ("attitude of another recording", False, True),
    ]


def turned_along(recording, sign):
    """Share of the change of the field over 0.2 s that the gyroscope explains."""
    field = recording.stack("mag_x", "mag_y", "mag_z")
    field = field - torch.quantile(field, 0.5, dim=0)
    turn = sign * recording.stack("gyro_x", "gyro_y", "gyro_z").unfold(0, 10, 1).sum(-1) / 50.0
    change = field[10:] - field[:-10]
    reported = -torch.linalg.cross(turn[: len(change)], 0.5 * (field[10:] + field[:-10]))
    return float(torch.nn.functional.cosine_similarity(change, reported, dim=-1).median())


def test_a_wrong_or_foreign_gyroscope_does_not_fit():
    wrong, other = (SCENARIOS["useless"].draw(3, index, False, index).recording for index in (1, 2))
    assert turned_along(wrong, -1.0) > 0.8
    assert turned_along(wrong, 1.0) < -0.8
    assert abs(turned_along(other, 1.0)) < 0.5


def test_an_unrelated_field_has_no_constant_length():
    recording = SCENARIOS["useless"].draw(3, 0, False, 0).recording
    field = recording.stack("mag_x", "mag_y", "mag_z")
    length = (field - field.median(0).values).norm(dim=-1)
    assert float(length.std() / length.mean()) > 0.25
