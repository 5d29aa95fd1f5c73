"""The documentation as a browser shows it: nothing is cut or wider than its page."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CHROMIUM = os.environ.get("CHROMIUM")
if CHROMIUM is None:
    pytest.skip("make test-page runs these", allow_module_level=True)
sync_api = pytest.importorskip("playwright.sync_api", reason="make test-page installs playwright")
pytest.importorskip("mkdocs")

ROOT = Path(__file__).parents[2]
WIDER = """() => [
  ...(document.documentElement.scrollWidth > innerWidth ? ["the page"] : []),
  ...[...document.querySelectorAll("article .md-typeset__table, article pre > code")]
    .filter(each => (each.closest(".md-typeset__scrollwrap") ?? each).scrollWidth
                  > (each.closest(".md-typeset__scrollwrap") ?? each).clientWidth + 1)
    .map(each => each.innerText.slice(0, 60)),
  ...[...document.querySelectorAll("img")].filter(each => !each.alt || !each.naturalWidth).map(each => each.src),
]"""
"""Texts of the tables and code that are wider than the page, and pictures that have no text or are missing."""

NARROW = "tasks/"
"""Folder of pages with tables of seven columns, which scroll on a telephone."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    build = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--quiet",
        "--config-file",
        ROOT / "mkdocs.yml",
        "--site-dir",
        folder,
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    subprocess.run(build, check=True, cwd=ROOT, env=environment, timeout=300)
    return folder


@pytest.mark.parametrize("width", [1280, 400])
def test_nothing_is_wider_than_its_page(site, width):
    found = {}
    with (
        sync_api.sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"]) as browser,
    ):
        page = browser.new_page(viewport={"width": width, "height": 900})
        for path in sorted(site.rglob("index.html")):
            name = path.parent.relative_to(site).as_posix()
            page.goto(path.as_uri())
            page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true })")
            wider = page.evaluate(WIDER)
            if wider and not (width == 400 and name.startswith(NARROW) and "the page" not in wider):
                found[name] = wider
    assert found == {}
