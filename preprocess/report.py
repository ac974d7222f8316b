"""`report.html`: one self-contained page that shows what a build decided and measured."""

from __future__ import annotations

import base64
import html
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.images import Image, write_image
from preprocess.mesh import TexturedSurface
from preprocess.raster import rasterise

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: .5rem 0 1.5rem; }
th, td { padding: .15rem .8rem; text-align: right; border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
figure { display: inline-block; margin: 0 1rem 1rem 0; } img { width: 24rem; image-rendering: auto; background: #888; }
figcaption { color: #555; }
"""
PICTURE_PX = 768


def write_report(
    path: Path, manifest: Mapping[str, Any], surface: TexturedSurface, pictures: Mapping[str, NDArray[Any]]
) -> None:
    """Write the page.

    Parameters
    ----------
    path : Path
    manifest : dict
        As in manifest.json.
    surface : TexturedSurface
        The full mesh in its atlas.
    pictures : dict of str to (H, W, 3) float
        More pictures by caption, values in [0, 1].
    """
    atlas = manifest["atlas"]
    body = [
        f"<h1>{html.escape(manifest['name'])}</h1>",
        f"<p>Built from {html.escape(manifest['source']['file'])}. Atlas: {html.escape(str(atlas['mode']))}, "
        f"{atlas['charts']} charts, overlap {atlas['overlap']}.</p>",
        "<h2>Levels of detail</h2>",
        _table(manifest["lods"]),
        "<h2>Seams</h2>",
        "<p>Jump across the seams, in units of a colour's range, metres or unit vectors; rms over their length.</p>",
        _table(_seam_rows(manifest["textures"])),
        "<h2>Pictures</h2>",
        _figure("Atlas: charts in colour, seams in black", draw_atlas(surface)),
        *(_figure(caption, picture) for caption, picture in pictures.items()),
        "<h2>Notes</h2>",
        "<ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in manifest["warnings"]) + "</ul>",
        "<h2>Times</h2>",
        _table([{"stage": k, "seconds": round(v, 2)} for k, v in manifest["timings"].items()]),
    ]
    title = html.escape(manifest["name"])
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style><body>{''.join(body)}</body></html>\n"
    )
    path.write_text(page, encoding="utf-8")


def _seam_rows(textures: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for name, texture in textures.items():
        row: dict[str, Any] = {"texture": name, "size": "×".join(map(str, texture["size"])), "mips": texture["mips"]}
        seam = texture["seam"]
        for moment in ("before", "after", "stored"):
            levels = seam[moment] if isinstance(seam[moment], list) else [seam[moment]]
            for measure in ("rms", "max"):
                row[f"{moment} {measure}"] = max((level[measure] for level in levels), default=0.0)
        row["seam edges left"] = seam.get("left", 0)
        rows.append(row)
    return rows


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    names = list(dict.fromkeys(key for row in rows for key in row))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    lines = "".join(
        "<tr>" + "".join(f"<td>{_cell(row.get(name, ''))}</td>" for name in names) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{lines}</table>"


def _cell(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else html.escape(str(value))


def _figure(caption: str, picture: NDArray[Any]) -> str:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        write_image(file, Image(np.clip(picture[..., :3], 0.0, 1.0), "uint8"))
        data = base64.b64encode(file.read_bytes()).decode()
    return f'<figure><img src="data:image/png;base64,{data}"><figcaption>{html.escape(caption)}</figcaption></figure>'


def draw_atlas(surface: TexturedSurface, size_px: int = PICTURE_PX) -> NDArray[np.float64]:
    """The atlas with a colour a chart, triangles shaded lightly, (H, W, 3) float64 in [0, 1]."""
    coverage = rasterise(surface.uvs, surface.face_uvs, size_px, size_px, 0.0)
    charts = _chart_of_face(surface)
    palette = np.random.default_rng(7).uniform(0.45, 0.95, (int(charts.max(initial=0)) + 1, 3))
    picture = np.ones((size_px, size_px, 3))
    inside = coverage.inside
    near_edge = coverage.barycentrics[inside].min(axis=1) < 0.06
    picture[inside] = palette[charts[coverage.faces[inside]]] * np.where(near_edge, 0.85, 1.0)[:, None]
    return picture


def _chart_of_face(surface: TexturedSurface) -> NDArray[np.int64]:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    corners = surface.face_uvs
    rows, columns = corners[:, [0, 1]].ravel(), corners[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(surface.uvs),) * 2)
    labels = connected_components(graph, directed=False)[1]
    return labels[corners[:, 0]].astype(np.int64)
