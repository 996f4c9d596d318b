"""The examples of losses in networks, at a small size."""

import importlib.util
from pathlib import Path

import pytest
import torch

pytest.importorskip("lightning")

# advice such as more workers for the loader
pytestmark = [
    pytest.mark.filterwarnings("ignore::lightning.fabric.utilities.warnings.PossibleUserWarning"),
    pytest.mark.filterwarnings(r"ignore:.*LeafSpec.* is deprecated"),
]

FOLDER = Path(__file__).parents[2] / "examples" / "lightning"


def loaded(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def example():
    return loaded("heavy_tailed_channel")


def test_outliers_are_one_sided_and_in_one_channel(example):
    x, y = example.sample(0.25, seed=0)
    away = y - example.clean(x)
    assert float((away[:, 1] > 0.7).double().mean()) == pytest.approx(0.25, abs=0.04)
    assert float(away[:, 0].abs().max()) < 0.6
    assert float(away[:, 1].min()) > -0.6


def test_mkc_em_is_closer_to_the_clean_function_than_the_squared_error_and_hubers(example):
    error = {name: float(example.errors(example.trained(name, 0.25, 0, 8)).square().mean().sqrt())
             for name in ("MSE", "Huber", example.MKC_EM)}  # fmt: skip
    assert error[example.MKC_EM] < 0.3 * error["MSE"]
    assert error[example.MKC_EM] < 0.5 * error["Huber"]


def test_peers_have_the_slopes_of_their_definitions(example):
    z = torch.linspace(-3.0, 3.0, 7)
    # the general loss at alpha = 1 is Charbonnier's, sqrt(z^2 + 1) - 1
    torch.testing.assert_close(example.AdaptiveLoss.rho(z, torch.tensor(1.0)), (z.square() + 1.0).sqrt() - 1.0)


def test_losses_are_timed_in_turns():
    speed = loaded("speed")
    losses = {"squared": torch.nn.MSELoss(), "Gaussian": speed.LearnedGaussianNLL(4)}
    found = speed.measured(losses, rows=8, times=1, rounds=2, device=torch.device("cpu"))
    assert set(found) == set(losses)
    assert all(value > 0.0 for value in found.values())
