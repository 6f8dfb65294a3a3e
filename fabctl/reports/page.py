"""A report as one HTML file that opens offline."""

from __future__ import annotations

from importlib import resources

import jinja2

from fabctl.reports.model import Report


def render(report: Report) -> str:
    """Return the page; everything it shows is inside it."""
    source = resources.files("fabctl.reports").joinpath("page.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.from_string(source).render(report=report)
