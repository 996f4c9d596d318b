"""Files written by earlier versions: models load, and corrected simulations find the names that they import."""

from pathlib import Path

import torch

from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.recording import Recording

STORED_MODEL = Path(__file__).parent / "kept" / "model.json"

STORED_IMPORTS = """
from mkc_torch.effects.protocol import lagged
from mkc_torch.effects.waveforms import played
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.share import soft_clip
from mkc_torch.effects.dynamics.rate import beyond
from mkc_torch.simulation import Parameter
"""
"""All import lines that a stored corrected.py can have."""


def test_a_stored_model_corrects_a_recording_and_is_rewritten_unchanged():
    text = STORED_MODEL.read_text(encoding="utf-8")
    model = DiagnosedModel.from_json(text)
    assert [term.effect.id for term in model.terms] == ["offset_drift"]
    assert model.to_json() == text
    time = torch.linspace(0.0, 80.0, 50, dtype=torch.float64)
    measured = {f"mag_{axis}": torch.full_like(time, 30.0) for axis in "xyz"}
    columns, notes = model.correct(Recording({"time": time, **measured}))
    offset, gain = model.theta[:3], model.gammas[0]
    a, b, c, d, e, f = model.theta[3:9].tolist()
    matrix = torch.tensor([[a, d, e], [d, b, f], [e, f, c]], dtype=torch.float64)
    # a later recording is corrected by the final offset of the drift
    expected = matrix @ (torch.full((3,), 30.0).double() - offset - gain)
    field = torch.stack([columns[f"field_{axis}"] for axis in "xyz"])
    torch.testing.assert_close(field, expected.unsqueeze(-1).expand_as(field), rtol=1e-6, atol=2e-2)
    assert any("depends on the time" in note for note in notes)


def test_names_imported_by_stored_corrected_simulations_exist():
    import mkc_torch.effects

    names = {}
    exec(STORED_IMPORTS, names)
    for name in ("lagged", "played", "shifted", "soft_clip", "beyond"):
        assert names[name] is getattr(mkc_torch.effects, name)
