"""Render templates of reports."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from mkc_torch._support.typesetting import capital
from mkc_torch.calibration.coverage import nearest_axis
from mkc_torch.report.words import numbers as wording


def render(template: str, **values: Any) -> str:
    """Render a template of this package; values are escaped unless they are markup."""
    environment = Environment(
        loader=PackageLoader("mkc_torch.report"),
        autoescape=select_autoescape(["html", "html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["coded"] = _coded
    environment.globals.update(w=wording, capital=capital, nearest_axis=nearest_axis, zip=zip)
    return environment.get_template(template).render(**values)


def _coded(text: str) -> Markup:
    """Set the text between backticks as code."""
    parts = [escape(part) for part in text.split("`")]
    if len(parts) % 2 == 0:
        return escape(text)
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else p for i, p in enumerate(parts))
