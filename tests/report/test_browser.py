"""The page in a real browser without network: no requests, visible pictures, working buttons."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.report.browser import NO_WEBGL, SOFTWARE_WEBGL, Page, browser, chromium

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium on this machine")

KINDS = {"webgl": (SOFTWARE_WEBGL, "#webgl canvas"), "plain": (NO_WEBGL, "#planes")}


@pytest.fixture(scope="module", params=KINDS)
def shown(
    request: pytest.FixtureRequest, finished: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Page, str, str]]:
    """The page, its expected kind of viewer, and the element with the picture."""
    flags, element = KINDS[request.param]
    with browser(tmp_path_factory.mktemp("profile"), *flags) as page:
        page.open(finished / "report.html")
        yield page, request.param, element


def changed_share(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that differ."""
    return float((np.abs(before - after).max(-1) > 8).mean())


def test_the_right_viewer_runs_and_is_not_blank(shown: tuple[Page, str, str]) -> None:
    page, kind, element = shown
    assert page.evaluate("document.getElementById('viewer').dataset.viewer") == kind
    pixels = page.pixels(element)
    assert len(np.unique(pixels.mean(-1).round())) > 50
    assert pixels.std() > 10
    assert page.evaluate("document.getElementById('static').hidden") is True
    assert page.evaluate("document.getElementById('readout').textContent").startswith("at ")


def test_a_click_on_uncertainty_changes_the_picture(shown: tuple[Page, str, str]) -> None:
    page, _, element = shown
    before = page.pixels(element)
    page.click("[data-layer=uncertainty]")
    after = page.pixels(element)
    assert changed_share(before, after) > 0.02
    assert page.evaluate("document.getElementById('legend').hidden") is False
    page.click("[data-layer=volume]")
    assert changed_share(before, page.pixels(element)) < 0.002


def test_sliders_and_the_crosshair_move_things(shown: tuple[Page, str, str]) -> None:
    page, kind, element = shown
    before, place = page.pixels(element), page.evaluate("document.getElementById('readout').textContent")
    page.evaluate(
        "(function () { var one = document.getElementById('high'); one.value = Number(one.max) / 4;"
        " one.dispatchEvent(new Event('input')); })()"
    )
    page.wait("true", 0.5)
    assert changed_share(before, page.pixels(element)) > 0.02
    page.click(f"{element} canvas" if kind == "plain" else element)
    assert page.evaluate("document.getElementById('readout').textContent") != place


def test_outlines_can_be_switched(shown: tuple[Page, str, str]) -> None:
    page, _, element = shown
    before = page.pixels(element)
    page.click("[data-layer=mask]")
    assert page.evaluate("document.querySelector('[data-layer=mask]').getAttribute('aria-pressed')") == "true"
    assert changed_share(before, page.pixels(element)) > 0.002


@pytest.mark.parametrize("width", [1400, 400])
def test_nothing_sticks_out_sideways(shown: tuple[Page, str, str], width: int) -> None:
    page = shown[0]
    page.resize(width, 900)
    page.wait("true", 0.5)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.box("#viewer")["height"] > 250


def test_no_request_and_no_complaint(shown: tuple[Page, str, str]) -> None:
    """This test runs last, so that it covers all earlier clicks."""
    page = shown[0]
    page.wait("true", 0.5)
    assert {address.split(":")[0] for address in page.requests} <= {"file", "data", "blob"}
    assert sum(address.startswith("file:") for address in page.requests) == 1
    assert page.complaints == []
