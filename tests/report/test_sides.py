"""Sides agree with their letters in the pictures of the page and in both viewers in a real browser."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from g3r.report.page import report_html, write_report
from tests.report.browser import NO_WEBGL, SOFTWARE_WEBGL, Page, browser, chromium
from tests.report.planted_head import SIDES, blob, bright_corner, grid_of, section_of, with_planted_head

in_a_browser = pytest.mark.skipif(chromium() is None, reason="no Chromium on this machine")

SECTION = re.compile(r'<img alt="(\w+) section of the volume" src="data:image/png;base64,([^"]+)">')

LETTERS_OF_PLANE = """Array.from(document.querySelectorAll('#planes .plane:nth-child(%d) .side')).map(function (one) {
  var box = one.getBoundingClientRect(), frame = one.parentElement.getBoundingClientRect();
  return [one.textContent, (box.x + box.width / 2 - frame.x) / frame.width,
          (box.y + box.height / 2 - frame.y) / frame.height];
})"""
"""Script that returns each letter with its position from the left and the top of the picture, 0 to 1."""

WATCH_NIIVUE = """(function () {
  var kind = niivue.Niivue.prototype, scene = kind.drawScene, text = kind.drawText;
  kind.drawText = function (at, words) {
    window.drawnTexts.push([words, at[0], at[1]]);
    return text.apply(this, arguments);
  };
  kind.drawScene = function () {
    window.drawnTexts = []; window.drawnBy = this;
    return scene.apply(this, arguments);
  };
})()"""
TILES = """window.drawnBy.screenSlices.map(function (one) {
  return [one.axCorSag].concat(Array.from(one.leftTopWidthHeight));
})"""
NIIVUE_PLANES = ("axial", "coronal", "sagittal")
"""Names of the planes by NiiVue's numbers."""


def test_the_blob_is_one_sided() -> None:
    """The blob lies where the tests below expect it, and a mirrored one lies elsewhere."""
    seen = blob(grid_of("RAS"))
    axial = seen[::-1, ::-1, seen.shape[2] // 2].T
    assert bright_corner(axial * 2.5) == "top left"
    assert bright_corner(axial[:, ::-1] * 2.5) == "top right"
    assert bright_corner(axial[::-1] * 2.5) == "bottom left"


@pytest.mark.parametrize("axes", ["RAS", "LAS", "LPS", "PSR"])
def test_static_sections(axes: str, finished: Path, tmp_path: Path) -> None:
    """For files with any order and direction of axes."""
    text = report_html(with_planted_head(finished, tmp_path / "run", axes))
    found = SECTION.findall(text)
    assert [name for name, _ in found] == list(SIDES)
    assert {name: bright_corner(section_of(picture)) for name, picture in found} == dict.fromkeys(SIDES, "top left")
    assert "The patient's right is on the left." in text


@pytest.fixture(scope="module")
def page_of_head(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a volume that is stored from right to left and from front to back."""
    folder = with_planted_head(finished, tmp_path_factory.mktemp("planted") / "run", "LPS")
    return write_report(folder)


def opened(page: Page, path: Path, kind: str) -> None:
    page.open(path)
    assert page.evaluate("document.getElementById('viewer').dataset.viewer") == kind


def side_at(across: float, down: float) -> str:
    """Side of a picture for a position given as a share of its width and height."""
    near = {"left": across, "right": 1 - across, "top": down, "bottom": 1 - down}
    side = min(near, key=lambda name: near[name])
    assert near[side] < 0.15
    return side


@in_a_browser
def test_the_plain_viewer(page_of_head: Path, tmp_path: Path) -> None:
    with browser(tmp_path, *NO_WEBGL) as page:
        opened(page, page_of_head, "plain")
        for number, (plane, sides) in enumerate(SIDES.items(), start=1):
            box = f"#planes .plane:nth-child({number})"
            assert plane in page.evaluate(f"document.querySelector('{box}').textContent")
            assert bright_corner(page.pixels(f"{box} canvas").mean(-1)) == "top left", plane
            letters: list[Any] = page.evaluate(LETTERS_OF_PLANE % number)
            assert {side_at(across, down): letter for letter, across, down in letters} == sides, plane


@in_a_browser
def test_the_viewer_with_webgl(page_of_head: Path, tmp_path: Path) -> None:
    """NiiVue draws three tiles in one canvas, with the letters of the left and top sides on each."""
    with browser(tmp_path, *SOFTWARE_WEBGL) as page:
        opened(page, page_of_head, "webgl")
        page.evaluate(WATCH_NIIVUE)
        page.click("[data-layer=volume]")  # redraws it
        pixels = page.pixels("#webgl canvas").mean(-1)
        scale = pixels.shape[1] / page.evaluate("document.querySelector('#webgl canvas').width")
        tiles = {NIIVUE_PLANES[int(kind)]: box for kind, *box in page.evaluate(TILES)}
        texts = page.evaluate("window.drawnTexts")
    assert tiles.keys() == SIDES.keys()
    for plane, (left, top, width, height) in tiles.items():
        rows, columns = (slice(round(scale * a), round(scale * (a + b))) for a, b in ((top, height), (left, width)))
        assert bright_corner(pixels[rows, columns]) == "top left", plane
        inside = [words for words, x, y in texts if left <= x < left + width and top <= y < top + height]
        assert inside == [SIDES[plane]["left"] + SIDES[plane]["top"]], plane
