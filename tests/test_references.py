"""Links of documents lead to files and headings that are there, and so do citations of the method and paths."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
SOURCES = [
    path
    for folder in ("runtime", "preprocess", "shaders", "demos", "benchmarks", "tests")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in (".py", ".glsl", ".vert", ".frag", ".tesc", ".tese") and path != Path(__file__)
]
CITATION = re.compile(r"(\S*)\bmethod(?:\.md)?,\s+sections?\s+(\d+(?:(?:, | and |, and )\d+)*)")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
# A path of this repository in prose: `folder/…/file.ext`, as one word.
PATH = re.compile(r"`((?:runtime|preprocess|shaders|demos|benchmarks|tests|docs)/[\w/]+\.[a-z]+)`")


def prose(text: str) -> str:
    """A document without its code blocks."""
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(document: Path) -> set[str]:
    """What a link may name after the #, as GitHub makes it of headings."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ +(.*?)\s*$", prose(document.read_text(encoding="utf-8")), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        number = 0
        while (candidate := slug if not number else f"{slug}-{number}") in found:
            number += 1
        found.add(candidate)
    return found


def dead_links(document: Path, text: str) -> list[str]:
    """Links of a document's text that lead nowhere; those to other sites are not followed."""
    dead = []
    for target in LINK.findall(prose(text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (document.parent / name).resolve() if name else document
        if not path.exists() or (anchor and anchor not in anchors(path)):
            dead.append(target)
    return dead


def sections() -> set[int]:
    """Numbers of the method's headings."""
    text = (ROOT / "docs/method.md").read_text(encoding="utf-8")
    return {int(number) for number in re.findall(r"^## (\d+)\. ", text, re.MULTILINE)}


def dead_citations(text: str, known: set[int]) -> list[str]:
    """Citations of the method that name no file, or a section that it does not have. Comments may break lines."""
    dead = []
    for cited in CITATION.finditer(re.sub(r"\n\s*(?://|#)? *", " ", text)):
        numbers = {int(number) for number in re.findall(r"\d+", cited[2])}
        if not cited[0].lstrip("(").startswith("docs/method.md") or numbers - known:
            dead.append(cited[0])
    return dead


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    assert not dead_links(document, text)
    assert not [name for name in PATH.findall(text) if not (ROOT / name).exists()]


def test_citations_of_the_method_lead_to_a_heading() -> None:
    known, number = sections(), 0
    assert known == set(range(1, max(known) + 1))
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        number += len(CITATION.findall(text))
        assert not dead_citations(text, known), path
        assert not [name for name in PATH.findall(text) if not (ROOT / name).exists()], path
    assert number >= 15


def test_every_document_can_be_reached_from_the_readme() -> None:
    reached, ahead = set(), [ROOT / "README.md"]
    while ahead:
        document = ahead.pop()
        if document in reached:
            continue
        reached.add(document)
        targets = LINK.findall(document.read_text(encoding="utf-8"))
        ahead += [path for t in targets if (path := (document.parent / t.split("#")[0]).resolve()).suffix == ".md"]
    assert set(DOCUMENTS) <= reached, set(DOCUMENTS) - reached


def test_dead_ones_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A page, here\n\n## A page, here\n\n```\n[code](nowhere.md)\n```\n", encoding="utf-8")
    links = "[a](page.md#a-page-here) [b](#a-page-here-1) [c](gone.md) [d](page.md#gone) [e](https://example.org/x)"
    assert dead_links(page, links) == ["gone.md", "page.md#gone"]
    cited = "(docs/method.md, section 1) (docs/method.md, sections\n// 2 and 9) (method, section 1) a method, sections"
    assert dead_citations(cited, {1, 2}) == ["(docs/method.md, sections 2 and 9", "(method, section 1"]


def test_no_machine_path_is_in_the_repository() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.suffix in (".py", ".md", ".toml", ".glsl", ".vert", ".frag", ".cff", ".yaml") and path.exists():
            assert not re.search(r"/(?:home|Users)/\w+/", path.read_text(encoding="utf-8")), name
