"""The pages of the losses: numbers shared with other pages, computed tables, pictures, and functions to copy."""

import inspect
import math
import re
import runpy
import sys

import pytest
import torch
import torch.distributed

from mkc_torch import MKCDistribution, MKCLoss, fit_density
from tests.docs.pages import ROOT, blocks

LOSS, LOSSES = (ROOT / "docs" / f"{name}.md" for name in ("loss", "losses"))


def rows(page, first):
    """Return the cells of the table rows whose first cell matches, without the asterisks of bold type."""
    lines = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    cells = [[cell.strip().strip("*") for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if re.fullmatch(first, row[0])]


def definition_of(page, name, **names):
    """Execute the definition of a function or class in a page, and return it."""
    (block,) = [block for block in blocks(page) if re.search(rf"^(def|class) {name}\b", block.text, re.MULTILINE)]
    source = re.search(rf"^(?:def|class) {name}\b.*?(?=^\S|\Z)", block.text, re.MULTILINE | re.DOTALL)[0]
    exec(source, names)
    return names[name]


# --- numbers


def test_rows_for_wrong_targets_equal_those_of_the_page_of_wrong_targets():
    kept = {tuple(row[:3]): row[3:] for row in rows(ROOT / "docs" / "wrong_targets.md", "(Carseats|diabetes|diamonds)")}
    copied = rows(LOSSES, "(Carseats|diabetes|diamonds)")
    assert len(copied) == 10
    for row in copied:
        whole = kept[tuple(row[:3])]
        assert row[3:] == [*whole[:4], whole[6]], row[:3]
    (ranks,) = rows(ROOT / "docs" / "wrong_targets.md", "average rank")
    (copied,) = rows(LOSSES, "average rank.*")
    assert copied[3:] == [*ranks[3:7], ranks[9]]


def test_likelihoods_of_real_errors_equal_those_of_the_page_of_measurements():
    pattern = r"(departure delays|returns, S&P 500|fire claims)"
    measured = {row[0]: row[1:] for row in rows(ROOT / "docs" / "measured.md", pattern)}
    copied = rows(LOSSES, pattern)
    assert len(copied) == 3
    for row in copied:
        gauss, _, by_rule, student, several = measured[row[0]]
        assert row[1:] == [gauss, by_rule, student, several]


def test_errors_with_wrong_labels_equal_those_of_the_page_of_measurements():
    text = " ".join(LOSSES.read_text(encoding="utf-8").split())
    found = re.search(
        r"is ([\d.]+) % after the last epoch, compared with ([\d.]+) % for cross-entropy; without wrong labels it is "
        r"([\d.]+) %, compared with ([\d.]+) %",
        text,
    )
    (entropy,), (graduated,) = (
        rows(ROOT / "docs" / "measured.md", name) for name in ("cross-entropy", "correntropy, graduated σ")
    )
    measured = [graduated[3], entropy[3], graduated[1], entropy[1]]
    assert list(found.groups()) == [cell.split(" ")[0] for cell in measured]


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_the_first_figure_is_that_of_the_page_of_measurements(page):
    times = re.search(r"error is \[?(\d+) times\s+smaller", (ROOT / page).read_text(encoding="utf-8"))[1]
    text = (ROOT / "docs" / "measured.md").read_text(encoding="utf-8").partition("### The loss in a network")[2]
    ratio = float(re.search(r"^\| \*\*MKC, as it comes\*\* \| \*\*([\d.]+)\*\*", text, re.MULTILINE)[1])
    assert int(times) == int(1.0 / ratio)


def test_the_table_of_sigma_equals_the_density():
    table = rows(LOSS, "(∞|\\d)")
    assert [row[0] for row in table] == ["∞", "5", "4", "3", "2", "1"]
    for row in table:
        sigma = math.inf if row[0] == "∞" else float(row[0])
        for cell, level in ((row[1], 0.5), (row[2], 0.1)):
            reach = sigma * math.sqrt(-2.0 * math.log(level))
            assert cell == ("never" if math.isinf(sigma) else f"{reach:.1f} d")
        for cell, bound in ((row[3], 10.0), (row[4], 100.0)):
            density = MKCDistribution(*(torch.tensor(v, dtype=torch.float64) for v in (sigma, 1.0, bound)))
            share = 200.0 * float(density.cdf(torch.tensor(-3.0, dtype=torch.float64)))
            assert cell == f"{share:.2g} %"


def test_sigma_of_gaussian_noise_is_infinite_in_half_of_all_samples():
    error = torch.randn(100, 2000, 1, generator=torch.Generator().manual_seed(3))
    sigma = fit_density(error).sigma
    assert 0.35 < float(torch.isinf(sigma).double().mean()) < 0.65
    assert 0.1 < float((sigma < 7.0).double().mean()) < 0.4
    assert float(sigma.min()) > 3.5


# --- pictures


@pytest.mark.manual
def test_the_script_makes_the_pictures_of_the_page(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(sys, "argv", ["loss_pictures.py", "--output", str(tmp_path)])
    runpy.run_path(str(ROOT / "examples" / "loss_pictures.py"), run_name="__main__")
    made = {path.name for path in tmp_path.iterdir()}
    assert made == {path.name for path in (ROOT / "docs" / "pictures").glob("losses_*")}
    assert made == set(re.findall(r"pictures/(losses_\w+\.png)", LOSSES.read_text(encoding="utf-8")))
    assert min(path.stat().st_size for path in tmp_path.iterdir()) > 5000


# --- functions to copy


class TrainerStub:
    """Calls a ``compute_loss_func`` as the Trainer of transformers 5 does, gradients accumulated over batches."""

    def __init__(self, model, compute_loss_func):
        self.model, self.compute_loss_func = model, compute_loss_func

    def gradients(self, batches):
        """Gradients of the weights, accumulated over the batches."""
        self.model.zero_grad()
        count = sum(batch["labels"].ne(-100).sum() for batch in batches)
        for batch in batches:
            inputs = dict(batch)
            labels = inputs.pop("labels")
            outputs = self.model(**inputs)
            self.compute_loss_func(outputs, labels, num_items_in_batch=count).backward()
        return [parameter.grad.clone() for parameter in self.model.layers.parameters()]


@pytest.fixture
def network():
    """Return the network of the page with a loss without state, and its ``compute_loss_func``."""
    torch.manual_seed(0)
    network = definition_of(LOSSES, "Network", torch=torch, MKCLoss=MKCLoss)()
    network.criterion = MKCLoss(2, sigma=2.0, d=0.5, bound=50.0, reduction="sum")
    return network, definition_of(LOSSES, "compute_loss_func", network=network)


def test_the_function_for_transformers_has_the_signature_of_compute_loss_func(network):
    _, function = network
    signature = inspect.signature(function)
    assert list(signature.parameters) == ["outputs", "labels", "num_items_in_batch"]
    assert signature.parameters["num_items_in_batch"].default is None


def test_accumulated_batches_have_the_gradient_of_the_whole_batch(network):
    model, function = network
    features, labels = torch.randn(2, 60, 8, generator=torch.Generator().manual_seed(1))
    labels = labels[:, :2]
    trainer = TrainerStub(model, function)
    whole = trainer.gradients([{"features": features, "labels": labels}])
    parts = [
        {"features": f, "labels": t} for f, t in zip(features.split([10, 50]), labels.split([10, 50]), strict=True)
    ]
    torch.testing.assert_close(trainer.gradients(parts), whole)
    mean = MKCLoss(2, sigma=2.0, d=0.5, bound=50.0)(model(features)["logits"], labels)
    torch.testing.assert_close(function(model(features), labels, num_items_in_batch=None), mean)
    torch.testing.assert_close(function((model(features)["logits"],), labels, num_items_in_batch=labels.numel()), mean)


def test_gradients_of_a_loss_outside_the_wrapped_module_are_averaged(tmp_path):
    average = definition_of(LOSS, "average_gradients", torch=torch)
    loss = MKCLoss(2, d=0.5, bound=50.0)
    loss(torch.randn(20, 2), torch.randn(20, 2)).backward()
    before = [parameter.grad.clone() for parameter in loss.parameters()]
    torch.distributed.init_process_group("gloo", f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        average(loss)
    finally:
        torch.distributed.destroy_process_group()
    torch.testing.assert_close([parameter.grad for parameter in loss.parameters()], before)


def test_a_robust_scale_ignores_wrong_targets():
    """The block standardises targets with the median and a robust scale; its inverse returns the targets."""
    (block,) = [block for block in blocks(LOSS) if block.text.startswith("middle = ")]
    y = 60_000.0 + 20_000.0 * torch.randn(4000, 1, generator=torch.Generator().manual_seed(0))
    y[::5] *= 1000.0
    names = {"y": y}
    exec(block.text, names)
    assert abs(float(names["middle"]) - 60_000.0) < 10_000.0
    assert 0.9 < float(names["unit"]) / 20_000.0 < 1.6
    torch.testing.assert_close(names["target"] * names["unit"] + names["middle"], y, rtol=1e-4, atol=1e-4)
