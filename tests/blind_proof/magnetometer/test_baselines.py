import torch

from examples.blind_proof.draws import generator, normal
from examples.blind_proof.magnetometer.baselines import stepwise_bic
from examples.blind_proof.magnetometer.cases import draw_scene
from mkc_torch.recording.recording import Recording


def recorded(add, **columns):
    scene = draw_scene(generator(0), 40.0)
    measured = scene.field @ scene.sensor.soft.mT + scene.sensor.hard + 0.3 * normal(generator(1), 2000, 3) + add(scene)
    axes = dict(zip(("mag_x", "mag_y", "mag_z"), measured.unbind(-1), strict=True))
    return Recording({"time": scene.time, **axes, "temperature": scene.temperature, "current": scene.current} | columns)


def test_stepwise_bic_finds_nothing_in_white_noise():
    assert stepwise_bic(recorded(lambda scene: torch.zeros_like(scene.field))) == {
        "verdict": "adequate",
        "findings": [],
    }


def test_stepwise_bic_finds_a_step_with_its_onset():
    shift = torch.tensor([1.0, -2.0, 1.5]).double()
    found = stepwise_bic(recorded(lambda scene: (scene.time > 20.3)[:, None] * shift))["findings"]
    assert found[0]["effect"] == "hard_iron_step"
    assert abs(found[0]["onset"] - 20.3) <= 1.0


def test_stepwise_bic_finds_a_current_field_with_its_driver():
    way = torch.tensor([0.3, 0.3, -0.2]).double()
    found = stepwise_bic(recorded(lambda scene: scene.current[:, None] * way))["findings"]
    assert (found[0]["effect"], found[0]["drivers"]) == ("current_field", ["current"])


def test_stepwise_bic_has_no_result_without_an_ellipsoid():
    rest = torch.ones(50).double()
    flat = Recording({"time": torch.arange(50), "mag_x": rest, "mag_y": rest, "mag_z": rest})
    assert stepwise_bic(flat) is None
