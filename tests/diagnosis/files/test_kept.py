"""Files that were written for users before: models load, and corrected simulations import what they name."""

from pathlib import Path

import torch

from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.recording import Recording

KEPT = Path(__file__).parent / "kept" / "model.json"

IMPORTED = """
from mkc_torch.effects.protocol import lagged
from mkc_torch.effects.waveforms import played
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.share import soft_clip
from mkc_torch.effects.dynamics.rate import beyond
from mkc_torch.simulation import Parameter
"""
"""Every line that a corrected.py of the first edition can begin with."""


def test_a_model_corrects_a_recording_and_is_written_as_it_was():
    text = KEPT.read_text(encoding="utf-8")
    model = DiagnosedModel.from_json(text)
    assert [term.effect.id for term in model.terms] == ["offset_drift"]
    assert model.to_json() == text
    time = torch.linspace(0.0, 80.0, 50, dtype=torch.float64)
    measured = {f"mag_{axis}": torch.full_like(time, 30.0) for axis in "xyz"}
    columns, notes = model.correct(Recording({"time": time, **measured}))
    offset, gain = model.theta[:3], model.gammas[0]
    a, b, c, d, e, f = model.theta[3:9].tolist()
    matrix = torch.tensor([[a, d, e], [d, b, f], [e, f, c]], dtype=torch.float64)
    # what is left of a drift in a later recording is its end
    expected = matrix @ (torch.full((3,), 30.0).double() - offset - gain)
    field = torch.stack([columns[f"field_{axis}"] for axis in "xyz"])
    torch.testing.assert_close(field, expected.unsqueeze(-1).expand_as(field), rtol=1e-6, atol=2e-2)
    assert any("depends on the time" in note for note in notes)


def test_what_a_corrected_simulation_imports_is_there():
    import mkc_torch.effects

    names = {}
    exec(IMPORTED, names)
    for name in ("lagged", "played", "shifted", "soft_clip", "beyond"):
        assert names[name] is getattr(mkc_torch.effects, name)
