"""A clip with rounded corners, from a hard clip to a hyperbolic tangent."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.effects.share import soft_clip

VALUES = torch.linspace(-5.0, 5.0, 201, dtype=torch.float64)
POSITIVE = st.floats(0.05, 20.0)
SOFT = st.floats(0.01, 5.0)


def test_soft_clip_without_softness_is_a_clip():
    torch.testing.assert_close(soft_clip(VALUES, 1.5, 1e-4), VALUES.clamp(-1.5, 1.5), rtol=0.0, atol=3e-4)


def test_soft_clip_of_large_softness_is_a_hyperbolic_tangent():
    torch.testing.assert_close(soft_clip(VALUES, 1.5, 50.0), 1.5 * torch.tanh(VALUES / 1.5), rtol=0.0, atol=1e-3)


@settings(deadline=None)
@given(limit=POSITIVE, softness=SOFT)
def test_soft_clip_has_unit_slope_at_zero_and_stays_within_the_limit(limit, softness):
    at = torch.tensor([1e-6 * limit, 40.0 * limit * (1.0 + softness)], dtype=torch.float64)
    near, far = soft_clip(at, limit, softness).tolist()
    assert near / float(at[0]) == pytest.approx(1.0, abs=1e-4)
    assert far == pytest.approx(limit, rel=1e-9)
    course = soft_clip(limit * VALUES, limit, softness)
    assert bool((course.diff() >= -1e-12 * limit).all())
    assert float(course.abs().max()) <= limit * (1.0 + 1e-12)
    torch.testing.assert_close(course, -course.flip(0), rtol=0.0, atol=1e-12 * limit)


def test_derivatives_of_soft_clip_agree_with_differences():
    numbers = (VALUES[::20].clone(), torch.tensor(1.3).double(), torch.tensor(0.4).double())
    assert torch.autograd.gradcheck(soft_clip, [n.requires_grad_() for n in numbers])
    assert torch.autograd.gradcheck(soft_clip, numbers, check_forward_ad=True, check_backward_ad=False)


def test_soft_clip_keeps_the_dtype():
    assert soft_clip(VALUES.float(), 1.5, 0.1).dtype == torch.float32
