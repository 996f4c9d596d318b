"""The example of wrong labels, at a small size."""

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

PATH = Path(__file__).parents[2] / "examples" / "lightning" / "noisy_labels.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("noisy_labels", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_share_of_wrong_labels_is_the_requested_share(example):
    data = example.digits(0.4, seed=1)
    assert float((data.given != data.true).double().mean()) == pytest.approx(0.4, abs=0.04)
    assert data.given.unique().tolist() == list(range(10))
    assert len(data.images) + len(data.test_images) == 1797
    assert torch.equal(example.digits(0.0, seed=1).given, data.true)


def test_peer_losses_equal_their_definitions(example):
    logits, labels = torch.randn(6, 10, generator=torch.Generator().manual_seed(0)), torch.arange(6)
    error = torch.nn.functional.one_hot(labels, 10) - logits.softmax(1)
    torch.testing.assert_close(example.MeanAbsoluteError()(logits, labels), error.abs().sum(1).mean())
    square = error.square().sum(1)
    torch.testing.assert_close(example.CLoss()(logits, labels), (0.25 * (1.0 - torch.exp(-2.0 * square))).mean())


@pytest.mark.manual
def test_the_graduated_loss_does_not_memorise_and_identifies_wrong_labels(example):
    data = example.digits(0.6, seed=0)
    module, reference = (example.trained(name, data, 0, 30) for name in (example.GRADUATED, example.CROSS_ENTROPY))
    assert len(module.history) == 30
    assert module.criterion.sigma.item() == pytest.approx(0.8)
    assert module.history[-1] < 0.6 * reference.history[-1]
    wrong, right = example.doubted(module, data)
    assert wrong > 0.8
    assert right < 0.08


@pytest.mark.manual
def test_the_table_and_the_picture_have_all_losses(example, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(example, "SHARES", (0.0, example.SHOWN))
    found = example.table(seeds=1, epochs=1)
    example.picture(tmp_path / "picture.png", found)
    assert set(found) == set(example.LOSSES)
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*example.LOSSES, example.BEST_EPOCH))
    assert (tmp_path / "picture.png").stat().st_size > 10_000
