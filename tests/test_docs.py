"""The pages: built with warnings as errors, links, doctests, and what they must hold."""

import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def build(builder: str, source: Path, out: Path, doctrees: Path) -> subprocess.CompletedProcess:
    options = ("-W", "--keep-going", "-q", "-b", builder, "-d", doctrees)
    return subprocess.run(
        [sys.executable, "-m", "sphinx", *options, source, out],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> Path:
    """The folder of the built pages."""
    folder = tmp_path_factory.mktemp("docs")
    result = build("html", DOCS, folder / "html", folder / "doctrees")
    assert result.returncode == 0, result.stdout
    return folder / "html"


class Links(HTMLParser):
    """Where a page leads, and what can be led to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.anchors = {"", "top"}
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.links.update(v for k in ("href", "src") if (v := values.get(k)))
        self.anchors.update(v for k in ("id", "name") if (v := values.get(k)))


def broken_links(folder: Path) -> list[str]:
    """Links within a folder of pages that lead nowhere."""
    pages = {page.resolve(): Links(page) for page in folder.rglob("*.html")}
    broken = []
    for page, found in pages.items():
        for link in found.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            known = pages[target].anchors if target in pages else {""}
            if not target.is_file() or unquote(parts.fragment) not in known:
                broken.append(f"{page.relative_to(folder.resolve())}: {link}")
    return broken


@pytest.mark.docs
def test_links_within_the_pages_lead_somewhere(pages):
    assert broken_links(pages) == []


def test_broken_links_are_found(tmp_path):
    links = ("b.html", "b.html#there", "#here", "b.html#not", "c.html", "#not", "https://x.org/#y")
    anchors = "".join(f'<a href="{link}"></a>' for link in links)
    (tmp_path / "a.html").write_text(f'<p id="here">{anchors}</p>')
    (tmp_path / "b.html").write_text('<p id="there"></p>')
    wanted = {"a.html: b.html#not", "a.html: c.html", "a.html: #not"}
    assert set(broken_links(tmp_path)) == wanted


@pytest.mark.docs
def test_doctests(pages, tmp_path):
    result = build("doctest", DOCS, tmp_path, pages.parent / "doctrees")
    assert result.returncode == 0, result.stdout
    count = re.search(r"(\d+) tests\n *0 failures in tests", (tmp_path / "output.txt").read_text())
    assert count and int(count[1]) >= 10


@pytest.mark.docs
def test_all_robots_of_the_gallery_are_shown(pages):
    shown = Links(pages / "gallery.html").links
    for robot in ("walker", "crawler", "climber", "worm"):
        assert {f"_images/{robot}.gif", f"_images/{robot}.png"} <= shown


@pytest.mark.docs
def test_a_gallery_that_fails_fails_the_build(tmp_path):
    source = tmp_path / "docs"
    source.mkdir()
    shutil.copy(DOCS / "conf.py", source)
    (source / "index.rst").write_text("A page\n======\n")
    (source / "gallery.py").write_text("raise SystemExit(3)")
    result = build("html", source, tmp_path / "html", tmp_path / "doctrees")
    assert result.returncode != 0
    assert "gallery.py failed" in result.stdout


def test_every_module_is_in_the_api_once():
    paths = [path.relative_to(ROOT).with_suffix("") for path in (ROOT / "mpmopt").rglob("*.py")]
    modules = {".".join(path.parts).removesuffix(".__init__") for path in paths}
    listed = re.findall(r"^\.\. automodule:: (\S+)$", (DOCS / "api.rst").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(modules - {"mpmopt", "mpmopt.__main__"})


def test_every_page_is_in_one_group_of_the_contents():
    text = (DOCS / "index.rst").read_text()
    listed = re.findall(r"^   (\w+)$", text, re.MULTILINE)
    written = {path.stem for end in ("rst", "md") for path in DOCS.glob(f"*.{end}")} - {"index"}
    assert sorted(listed) == sorted(written)


@pytest.mark.docs
def test_no_page_has_a_table_of_contents_of_its_own(pages):
    # The theme shows one beside the page, and an error in red in the place of another.
    for page in pages.glob("*.html"):
        assert 'class="contents' not in page.read_text(), page.name


def test_every_equation_of_the_theory_is_numbered():
    text = (DOCS / "theory.rst").read_text()
    equations = text.count(".. math::\n")
    assert equations == len(re.findall(r"\.\. math::\n   :label: \w+\n", text)) > 30
