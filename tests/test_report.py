"""report.html: whole, readable and self-contained."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from builders_erase import make_cube

from preprocess.export.report import write_report
from preprocess.files.images import Image, write_image

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Text, tags that close in order, and the addresses of pictures."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.sources: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.sources += [value or "" for key, value in attrs if key in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def manifest(**changes: Any) -> dict[str, Any]:
    def seam(before: float, stored: float) -> dict[str, Any]:
        return {
            "before": {"rms": before / 2, "max": before},
            "stored": [{"rms": 0.0, "max": stored / 2}, {"rms": 0.0, "max": stored}],
        }

    return {
        "name": "a <b> & c",
        "source": {"file": "a.glb"},
        "atlas": {"mode": "keep", "charts": 6, "overlap": 0, "coverage": 0.5},
        "lods": [
            {"faces": 12, "vertices": 8, "error_m": 0.0, "exact": True, "uv_bound_px": 0.0},
            {"faces": 8, "vertices": 6, "error_m": 0.01, "exact": False, "uv_bound_px": 1.5},
            {"faces": 4, "vertices": 4, "error_m": None, "exact": True, "uv_bound_px": 0.0},
        ],
        "textures": {
            "base_color": {"file": "base_color.png", "size": [8, 8], "mips": 2, "seam": seam(0.2, 0.4 / 255)},
            "position": {"file": "position.exr", "size": [8, 8], "mips": 1, "seam": seam(0.003, 0.0)},
        },
        "warnings": ["one <note>"],
        "timings": {"load": 0.1},
        **changes,
    }


def test_the_page_is_whole_and_says_what_its_figures_mean(tmp_path: Path) -> None:
    write_image(tmp_path / "base_color.png", Image(np.zeros((8, 8, 3))))
    write_report(tmp_path / "report.html", manifest(), make_cube(), {"a caption": np.zeros((4, 4, 3))})
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.open == ["html", "body"] or not page.open  # the end tags of those two may be left out
    assert len(page.sources) == 3 and all(source.startswith("data:image/png;base64,") for source in page.sources)
    words = page.words
    assert "a <b> & c" in words and "one <note>" in words and "a caption" in words
    assert "51" in words and "0.4" in words  # colours in steps of 255: source and stored, the worst mip
    assert "3" in words and "mm" in words  # positions in millimetres
    # One pixel of 1,080 rows at 35 degrees: 0.01 m * 1080 / (2 tan 17.5 degrees)
    assert "17.1" in words and "relaxed by 1.5 texels" in words and "not measured" in words


def test_nothing_to_note_is_said(tmp_path: Path) -> None:
    atlas = {"mode": "unwrap", "charts": 1, "overlap": 2, "coverage": None}
    write_report(tmp_path / "report.html", manifest(warnings=[], atlas=atlas), make_cube(), {})
    words = Page((tmp_path / "report.html").read_text(encoding="utf-8")).words
    assert "nothing" in words and any("2 pairs of triangles overlap" in text for text in words)
