"""Losses and heads exported to ONNX, run by another runtime on batches of other sizes."""

import math

import pytest
import torch
from torch import nn

from mkc_torch import GeneralizedCrossEntropyLoss, HeteroscedasticMKCLoss, LELoss, MKCConvHead, MKCHead, MKCLoss

pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
runtime = pytest.importorskip("onnxruntime")

# the exporter's own
pytestmark = pytest.mark.filterwarnings("ignore")

RTOL = 4e-6
"""Rounding of float32 over the thirty operations between features and σ."""


class Criterion(nn.Module):
    def __init__(self, loss, outputs=2):
        super().__init__()
        self.net, self.loss = nn.Linear(5, outputs), loss

    def forward(self, x, y):
        return self.loss(self.net(x), y)


class HeadWithLikelihood(nn.Module):
    """A network with a head, and its likelihood where there are targets."""

    def __init__(self):
        super().__init__()
        self.body, self.head = nn.Linear(5, 8), MKCHead(8, 2, bound=50.0, d_min=1e-3, sigma_init=100.0)
        self.loss = HeteroscedasticMKCLoss(bound=50.0)
        with torch.no_grad():
            self.head.scales.weight.normal_(0.0, 4.0)

    def forward(self, x, y):
        prediction, sigma, d = self.head(self.body(x).tanh())
        return prediction, sigma, d, self.loss(prediction, y, sigma, d)


def batch(count, labels=False):
    generator = torch.Generator().manual_seed(count)
    x = torch.randn(count, 5, generator=generator)
    if labels:
        return x, torch.randint(0, 3, (count,), generator=generator)
    return x, 3.0 * torch.randn(count, 2, generator=generator)


def assert_export_equals_module(module, make, sizes=(1, 3, 17)):
    """Assert that the exported module equals the module on batches of other sizes."""
    module.eval()
    size = torch.export.Dim("samples", min=1)
    given = make(4)
    program = torch.onnx.export(module, given, dynamo=True, dynamic_shapes=[{0: size}] * len(given), verbose=False)
    session = runtime.InferenceSession(program.model_proto.SerializeToString())
    for count in sizes:
        given = make(count)
        found = session.run(None, {i.name: v.numpy() for i, v in zip(session.get_inputs(), given, strict=True)})
        with torch.no_grad():
            expected = module(*given)
        for value, other in zip(found, expected if isinstance(expected, tuple) else (expected,), strict=True):
            torch.testing.assert_close(torch.from_numpy(value), other, rtol=RTOL, atol=1e-7)


def trained(loss):
    torch.manual_seed(0)
    module = Criterion(loss)
    for count in range(20, 26):
        module(*batch(count)).backward()
    return module


@pytest.mark.e2e
def test_an_exported_head_and_its_likelihood_equal_the_module():
    torch.manual_seed(0)
    module = HeadWithLikelihood()
    # widths that a sigmoid with seven decimals rounds to 0
    assert float(module(*batch(17))[1].max()) > 500.0
    assert_export_equals_module(module, batch)


def test_an_exported_head_of_images_equals_the_module():
    torch.manual_seed(0)
    assert_export_equals_module(
        MKCConvHead(3, 2, bound=50.0, d_min=1e-3),
        lambda count: (torch.randn(count, 3, 4, 5, generator=torch.Generator().manual_seed(count)),),
    )


@pytest.mark.e2e
@pytest.mark.parametrize(
    "options",
    [
        {"d": 1.0, "bound": 50.0, "sigma": 200.0, "reduction": "none"},
        {"d": 1.0, "bound": 50.0, "sigma": math.inf, "learn_sigma": False, "learn_d": False, "reduction": "sum"},
    ],
    ids=["learned", "fixed"],
)
def test_an_exported_loss_with_given_d_equals_the_module(options):
    torch.manual_seed(0)
    assert_export_equals_module(Criterion(MKCLoss(2, **options)), batch)


@pytest.mark.e2e
@pytest.mark.parametrize("settled", [False, True])
def test_an_exported_loss_with_auto_d_equals_the_module_before_and_after_freezing(settled):
    module = trained(MKCLoss(2))
    if settled:
        module.loss.freeze_scale()
    assert_export_equals_module(module, batch)


@pytest.mark.e2e
def test_exported_losses_of_labels_and_of_entropy_equal_the_module():
    torch.manual_seed(0)
    assert_export_equals_module(Criterion(GeneralizedCrossEntropyLoss(), 3), lambda count: batch(count, labels=True))
    assert_export_equals_module(Criterion(LELoss()), batch, sizes=(2, 3, 17))
