"""The site of docs/ builds without warnings, and its pages need no other server."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.rooms import REPOSITORY

CONFIG = REPOSITORY / "mkdocs.yml"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; pages missing in the menu and broken links are warnings, which fail the build."""
    folder = tmp_path_factory.mktemp("site")
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--config-file", str(CONFIG)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [*line, "--site-dir", str(folder)], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_document_is_a_page(site: Path) -> None:
    for path in (REPOSITORY / "docs").glob("*.md"):
        name = "index" if path.stem == "README" else path.stem
        assert (site / f"{name}.html").is_file(), path.name
    for outside in ("CONTRIBUTING", "CHANGELOG", "MODEL_CARD", "notebook"):
        assert (site / f"{outside}.html").is_file(), outside


def test_no_page_needs_another_server(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        asked = re.findall(r'<(?:script|img|iframe)[^>]* src="([^"]+)"|<link[^>]* href="([^"]+)"', text)
        assert not [one for pair in asked for one in pair if one.startswith(("http:", "https:", "//"))], page.name


def test_links_within_the_site_lead_somewhere(site: Path) -> None:
    """This includes links in raw HTML and in pages from outside docs/."""
    for page in site.glob("*.html"):
        for link in re.findall(r'<a[^>]* href="([^"#]+)', page.read_text(encoding="utf-8")):
            if page.name != "404.html" and not link.startswith(("http", "mailto:")):
                assert (page.parent / link).exists(), f"{page.name}: {link}"


def test_equations_are_written_out(site: Path) -> None:
    text = (site / "how.html").read_text(encoding="utf-8")
    source = (REPOSITORY / "docs" / "how.md").read_text(encoding="utf-8")
    assert 2 * text.count('<div class="equation"><math') == source.count("$$")
    assert "arithmatex" not in text
    assert r"\frac" not in re.sub(r"<annotation.*?</annotation>", "", text)


def test_nothing_is_left_of_the_markup(site: Path) -> None:
    """Leftovers come from lists and tables without an empty line before them, and from signs taken for tags."""
    for page in site.glob("*.html"):
        text = page.read_text(encoding="utf-8")
        text = re.sub(r"<(pre|code|math|script)\b.*?</\1>", "", text, flags=re.DOTALL)
        for part in re.findall(r"<(?:p|li)>(.*?)</(?:p|li)>", text, flags=re.DOTALL):
            assert not re.search(r"\n(?:- |\d+\. |\|)", part), f"{page.name}: {part}"
        assert not re.search(r"<[a-z]+ [^<>]*,=", text), page.name


def test_folded_tables_are_tables(site: Path) -> None:
    for page in site.glob("*.html"):
        for folded in re.findall(r"<details>.*?</details>", page.read_text(encoding="utf-8"), flags=re.DOTALL):
            assert "| ---" not in folded, page.name


def test_search_finds_all_pages(site: Path) -> None:
    text = (site / "search" / "search_index.js").read_text(encoding="utf-8")
    for page in ("gaps", "troubleshooting", "api"):
        assert f'"location":"{page}.html"' in text


def test_the_menu_has_the_parts() -> None:
    text = CONFIG.read_text(encoding="utf-8")
    menu = [part for entry in yaml.safe_load(text)["nav"] for part in entry]
    assert menu == ["Start", "How to", "When it goes wrong", "How it works", "Results", "Reference"]


def test_the_questions_are_seventeen() -> None:
    """The page has seventeen needs of users, and one heading for all other needs."""
    text = (REPOSITORY / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    assert len(re.findall(r"^## ", text, flags=re.MULTILINE)) == 17 + 1
