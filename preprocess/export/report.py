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

from preprocess.files.images import Image, write_image
from preprocess.mesh.edges import chart_of_faces
from preprocess.mesh.raster import rasterise
from preprocess.mesh.surface import TexturedSurface

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: .5rem 0 1.5rem; }
th, td { padding: .15rem .8rem; text-align: right; border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
figure { display: inline-block; margin: 0 1rem 1rem 0; } img { width: 24rem; image-rendering: auto; background: #888; }
figcaption { color: #555; } img.whole { width: auto; max-width: none; }
"""
PICTURE_PX = 768
SCREEN_ROWS, FOVY_RAD = 1080, np.deg2rad(35.0)  # the screen and the lens for which distances are given
TEXTURES = {  # what each texture is, for people
    "position": "where the surface is",
    "normal": "which way it faces, in object space",
    "weights": "which joints move it",
    "base_color": "its colours",
    "orm": "occlusion, roughness and metal in red, green and blue",
    "emissive": "what glows",
}
SHOWN = ("base_color", "emissive", "orm", "normal")


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
        f"<p>Built from {html.escape(manifest['source']['file'])}. {_describe_atlas(atlas)}</p>",
        "<h2>Levels of detail</h2>",
        "<p>All levels share the same textures. The largest error is how far a level strays from the full mesh, in any "
        f"sampled pose; from the distance beside it that is under a pixel of a screen of {SCREEN_ROWS} rows "
        f"({np.rad2deg(FOVY_RAD):.0f}° of view). Exact levels keep every seam; a relaxed level moves seams by up to so "
        "many texels, which its distance hides.</p>",
        _table([_lod_row(level, lod) for level, lod in enumerate(manifest["lods"])]),
        "<h2>Seams</h2>",
        "<p>How much the two sides of a seam differ at most: in the source, and in what is stored now, over all mip "
        "levels. Colours count in steps of 255, positions in millimetres, the rest in thousandths of their range. "
        "Half a step cannot be seen. Positions and weights are read on one side of a seam alone, so that what is drawn "
        "never opens, whatever they differ by. Seam edges left alone were taken for hard edges or painted borders: the "
        "pictures below show them in red. If a red one is a fault, build again with a larger --keep-borders, or off."
        "</p>",
        _table(_seam_rows(manifest["textures"])),
        "<h2>Pictures</h2>",
        "<p>Click a picture to see it at its full size.</p>",
        _figure("Atlas: charts in colour", draw_atlas(surface)),
        *(_figure(caption, picture) for caption, picture in pictures.items()),
        *_stored_pictures(path.parent, manifest["textures"]),
        "<h2>Notes</h2>",
        "<p>Everything that was changed, dropped or approximated.</p>",
        "<ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in manifest["warnings"] or ["nothing"]) + "</ul>",
        "<h2>Times</h2>",
        _table([{"stage": k, "seconds": round(v, 2)} for k, v in manifest["timings"].items()]),
    ]
    title = html.escape(manifest["name"])
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style><body>{''.join(body)}</body></html>\n"
    )
    path.write_text(page, encoding="utf-8")


def _describe_atlas(atlas: Mapping[str, Any]) -> str:
    """The atlas in a sentence or two."""
    modes = {
        "keep": "Its own texture coordinates were kept, with seams made straight",
        "repack": "Its charts were packed anew, so that none overlap, with seams made straight",
        "unwrap": "Its surface was unwrapped anew",
    }
    how = modes.get(str(atlas["mode"]), html.escape(str(atlas["mode"])))
    overlap = f" {atlas['overlap']} pairs of triangles overlap." if atlas["overlap"] else ""
    return f"{how}: {atlas['charts']} charts, {100 * (atlas.get('coverage') or 0):.0f} % of the texture used.{overlap}"


def _lod_row(level: int, lod: Mapping[str, Any]) -> dict[str, Any]:
    error_m = lod["error_m"]
    row: dict[str, Any] = {"level": level, "faces": lod["faces"], "vertices": lod["vertices"]}
    row["largest error, mm"] = "not measured" if error_m is None else 1000.0 * error_m
    row["from, m"] = "" if error_m is None else error_m * SCREEN_ROWS / (2 * np.tan(FOVY_RAD / 2))
    exact = lod.get("exact", True)
    row["seams"] = "exact" if exact else f"relaxed by {lod.get('uv_bound_px') or 0:.1f} texels"
    return row


def _seam_rows(textures: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for name, texture in textures.items():
        seam = texture["seam"]
        unit = 255.0 if name in ("base_color", "emissive", "orm") else 1000.0
        row: dict[str, Any] = {"texture": name, "what": TEXTURES.get(name, "")}
        row["size"] = "×".join(map(str, texture["size"]))
        row["mip levels"] = texture["mips"]
        for moment, title in (("before", "source"), ("stored", "stored")):
            levels = seam[moment] if isinstance(seam[moment], list) else [seam[moment]]
            row[title] = unit * max((level["max"] for level in levels), default=0.0)
        row["unit"] = "steps of 255" if unit == 255.0 else "mm" if name == "position" else "‰"
        row["seam edges left"] = seam.get("left", 0)
        rows.append(row)
    return rows


def _stored_pictures(folder: Path, textures: Mapping[str, Any]) -> list[str]:
    """The stored textures that browsers show."""
    found = []
    for name in SHOWN:
        file = folder / str(textures.get(name, {}).get("file", ""))
        if file.suffix == ".png" and file.is_file():
            size = "×".join(map(str, textures[name]["size"]))
            found.append(_figure_of(f"{file.name}, {size}: {TEXTURES[name]}", file.read_bytes()))
    return found


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
        return _figure_of(caption, file.read_bytes())


def _figure_of(caption: str, png: bytes) -> str:
    data = base64.b64encode(png).decode()
    text = html.escape(caption)
    toggle = "this.classList.toggle('whole')"
    return (
        f'<figure><img alt="{text}" onclick="{toggle}" src="data:image/png;base64,{data}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def draw_atlas(surface: TexturedSurface, size_px: int = PICTURE_PX) -> NDArray[np.float64]:
    """The atlas with a colour per chart, triangles shaded lightly, (H, W, 3) float64 in [0, 1]."""
    coverage = rasterise(surface.uvs, surface.face_uvs, size_px, size_px, 0.0)
    charts = chart_of_faces(surface)
    palette = np.random.default_rng(7).uniform(0.45, 0.95, (int(charts.max(initial=0)) + 1, 3))
    picture = np.ones((size_px, size_px, 3))
    inside = coverage.inside
    near_edge = coverage.barycentrics[inside].min(axis=1) < 0.06
    picture[inside] = palette[charts[coverage.faces[inside]]] * np.where(near_edge, 0.85, 1.0)[:, None]
    return picture
