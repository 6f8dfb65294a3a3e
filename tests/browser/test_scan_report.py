"""The scan report in a real browser: it draws, turns, answers a click, fetches nothing and complains of nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from design.targets import cap
from fabctl.records.folder import RunFolder, start_run
from fabctl.reports.scan import write_scan_report
from fabctl.scan.job import Request, compare, record
from simulators.photogrammetry import ScanPlan, scan
from simulators.scanner import write_cloud

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--disable-background-networking",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
]  # fmt: skip

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium (apt-get install chromium)"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Return the record of one comparison, with its report written."""
    from design.meshfiles import write_mesh

    folder = tmp_path_factory.mktemp("scan")
    mesh = cap(edge_mm=6.0)
    write_mesh(folder / "target.ply", mesh)
    plan = ScanPlan(seed=2, points_count=15_000, scale_ratio=1.0, bump_frac=0.01)
    write_cloud(folder / "cloud.ply", scan(mesh.vertices_mm, mesh.faces, plan))
    request = Request(folder / "cloud.ply", folder / "target.ply", scale="known", tolerance_frac=0.01)
    made = start_run(folder / "runs", "scan", inputs=request.files(), seed=0)
    record(made, compare(request))
    write_scan_report(made)
    return made


@pytest.fixture(scope="module")
def page(run: RunFolder) -> Iterator[tuple[Any, list[str], list[str]]]:
    """Return the opened page, what it fetched, and what it complained of."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        tab = browser.new_page(viewport={"width": 1200, "height": 1000})
        fetched: list[str] = []
        complaints: list[str] = []
        tab.on("request", lambda r: None if r.url.startswith("data:") else fetched.append(r.url))
        tab.on("console", lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None)
        tab.on("pageerror", lambda e: complaints.append(str(e)))
        tab.goto((run.path / "artefacts" / "report.html").as_uri())
        tab.wait_for_selector(".v3[data-drawn]")
        yield tab, fetched, complaints
        browser.close()


def pixels(tab: Any) -> np.ndarray:
    """Return the view's canvas as RGB."""
    import io

    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(tab.locator(".v3 canvas").screenshot())).convert("RGB")).astype(int)


def test_the_view_draws_the_surface_in_its_colours(page: tuple[Any, list[str], list[str]]) -> None:
    shown = pixels(page[0])
    drawn = (shown < 250).any(axis=2)
    assert 0.1 < drawn.mean() < 0.9
    strong = (shown[..., 0] - shown[..., 2] > 60) & drawn
    assert strong.any(), "the bump should be red"


def test_dragging_turns_the_view(page: tuple[Any, list[str], list[str]]) -> None:
    tab = page[0]
    before = pixels(tab)
    box = tab.locator(".v3 canvas").bounding_box()
    tab.mouse.move(box["x"] + 200, box["y"] + 200)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 330, box["y"] + 150, steps=5)
    tab.mouse.up()
    tab.wait_for_timeout(200)
    assert (np.abs(pixels(tab) - before).max(axis=2) > 20).mean() > 0.02


def test_a_click_tells_the_value_of_that_point(page: tuple[Any, list[str], list[str]], run: RunFolder) -> None:
    tab = page[0]
    tab.get_by_role("button", name="top").click()
    tab.wait_for_timeout(200)
    box = tab.locator(".v3 canvas").bounding_box()
    tab.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    label = tab.locator(".v3-label")
    assert "mm = " in label.inner_text() and "%" in label.inner_text()
    with np.load(run.path / "artefacts" / "map.npz") as made:
        apex = int(np.argmax(made["vertices_mm"][:, 2]))
        expected = float(made["deviation_mm"][apex])
    assert math.isclose(float(label.get_attribute("data-value")), expected, abs_tol=0.3)


def test_the_scale_is_shown_in_mm_and_percent(page: tuple[Any, list[str], list[str]]) -> None:
    ticks = page[0].locator(".v3-ticks").inner_text()
    assert "mm" in ticks and "%" in ticks


def test_it_prints_on_two_pages(page: tuple[Any, list[str], list[str]]) -> None:
    import re

    printed = page[0].pdf(format="A4", prefer_css_page_size=True)
    assert len(re.findall(rb"/Type\s*/Page[^s]", printed)) <= 2


def test_nothing_is_fetched_and_nothing_complained_of(page: tuple[Any, list[str], list[str]]) -> None:
    _, fetched, complaints = page
    assert [url for url in fetched if not url.startswith("file:")] == []
    assert complaints == []
