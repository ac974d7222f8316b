"""Packs the artist's charts anew: same shapes, new places (and quarter turns) in the unit square, with a gutter.

Charts are rasterised conservatively onto a coarse grid, grown by half the gutter, and placed largest first at the
lowest free place of the grid, in the best of four turns; the largest scale at which all find a place is searched for
by bisection. Bits of a grid row are tested 64 at a time.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from preprocess.arrays import Floats
from preprocess.mesh.surface import TexturedSurface
from preprocess.numerics.jit import entry

log = logging.getLogger(__name__)

Int64s = NDArray[np.int64]

GRID_CELLS = 512  # cells a side of the packing grid, at most one a texel
FEW_CHARTS_CELLS = 256  # the same where there are so many charts that time matters more than fill
MANY_CHARTS = 400
SCALE_STEPS = 9  # of bisection: the scale is within 1/512 of the best that the order allows
BEST_FILL = 0.97  # no packing of real charts fills more: where the search starts


@dataclass(frozen=True)
class Repacked:
    """A surface whose charts lie apart in the unit square.

    Attributes
    ----------
    surface : TexturedSurface
        Texture vertices are numbered anew (a vertex shared by two charts is two); faces keep their order.
    face_charts : (F,) int64
        Chart of every face.
    scales : (C,) float64
        New uv length a source uv length, a chart.
    coverage : float
        Share of the square that charts cover, their gutters not counted.
    """

    surface: TexturedSurface
    face_charts: Int64s
    scales: Floats
    coverage: float


def find_charts(surface: TexturedSurface) -> Int64s:
    """Charts: faces that meet at uv edges without folding over, (F,) int64, numbered in the order of their first face.

    Faces that share a texture vertex alone, or lie on the same side of a shared uv edge (a mirrored half), belong to
    different charts. Faces without area belong with any neighbour.
    """
    corners, uv_corners = surface.faces.astype(np.int64), surface.face_uvs.astype(np.int64)
    uv = surface.uvs[uv_corners]
    p, q = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    sign = np.sign(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    starts, ends = uv_corners.ravel(), np.roll(uv_corners, -1, axis=1).ravel()
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    tips = np.sort(np.stack([corners.ravel(), np.roll(corners, -1, axis=1).ravel()], axis=1), axis=1)
    keys = np.column_stack([low, high, tips])
    order = np.lexsort(keys.T[::-1])
    same = np.flatnonzero((keys[order][1:] == keys[order][:-1]).all(axis=1))
    left, right = order[same] // 3, order[same + 1] // 3
    joined = sign[left] * sign[right] >= 0.0
    left, right = left[joined], right[joined]
    links = coo_array((np.ones(len(left), np.int8), (left, right)), (len(corners),) * 2)
    labels = connected_components(links, directed=False)[1]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse.reshape(-1)]


def separate_charts(surface: TexturedSurface, face_charts: Int64s) -> tuple[TexturedSurface, Int64s]:
    """Give every chart texture vertices of its own: the surface, and the chart of every texture vertex (T,)."""
    keys = np.repeat(face_charts, 3) * max(len(surface.uvs), 1) + surface.face_uvs.ravel()
    unique, index = np.unique(keys, return_inverse=True)
    uvs = surface.uvs[unique % max(len(surface.uvs), 1)]
    face_uvs = index.reshape(-1, 3).astype(np.int32)
    return TexturedSurface(surface.positions, surface.faces, uvs, face_uvs), unique // max(len(surface.uvs), 1)


@entry
def _rasterise(points, triangles, reach, width, height):  # type: ignore[no-untyped-def]
    """Cells within `reach` of a chart's triangles, (height, width) uint8; points in cells, cell (0, 0) from 0 to 1."""
    cells = np.zeros((height, width), np.uint8)
    for t in range(len(triangles)):
        a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        x0 = max(int(np.floor(min(a[0], b[0], c[0]) - reach - 0.5)), 0)
        x1 = min(int(np.ceil(max(a[0], b[0], c[0]) + reach - 0.5)), width - 1)
        y0 = max(int(np.floor(min(a[1], b[1], c[1]) - reach - 0.5)), 0)
        y1 = min(int(np.ceil(max(a[1], b[1], c[1]) + reach - 0.5)), height - 1)
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if cells[y, x]:
                    continue
                px, py = x + 0.5, y + 0.5
                inside = area != 0.0
                near = np.inf
                for k in range(3):
                    p = a if k == 0 else (b if k == 1 else c)
                    q = b if k == 0 else (c if k == 1 else a)
                    dx, dy = q[0] - p[0], q[1] - p[1]
                    if ((px - p[0]) * dy - (py - p[1]) * dx) * area > 0.0:
                        inside = False
                    square = dx * dx + dy * dy
                    t_near = 0.0
                    if square > 0.0:
                        t_near = min(max(((px - p[0]) * dx + (py - p[1]) * dy) / square, 0.0), 1.0)
                    ex, ey = p[0] + t_near * dx - px, p[1] + t_near * dy - py
                    near = min(near, ex * ex + ey * ey)
                if inside or near <= reach * reach:
                    cells[y, x] = 1
    return cells


@entry
def _find_place(occupied, rows, width, size, first_row):  # type: ignore[no-untyped-def]
    """Lowest, then leftmost place of a bitmap `rows` (h, words) in the grid, as (x, y); (-1, -1) if there is none."""
    height, words = rows.shape
    clash = 0  # the row that clashed last is likely to clash again
    for y in range(first_row, size - height + 1):
        for x in range(size - width + 1):
            word, shift = x >> 6, np.uint64(x & 63)
            free = True
            for step in range(height):
                r = (clash + step) % height
                for k in range(words):
                    bits = rows[r, k]
                    hit = occupied[y + r, word + k] & (bits << shift)
                    if shift > np.uint64(0):
                        hit |= occupied[y + r, word + k + 1] & (bits >> (np.uint64(64) - shift))
                    if hit != np.uint64(0):
                        free = False
                        break
                if not free:
                    clash = r
                    break
            if free:
                return x, y
    return -1, -1


@entry
def _occupy(occupied, rows, x, y):  # type: ignore[no-untyped-def]
    """Mark a bitmap at its place."""
    word, shift = x >> 6, np.uint64(x & 63)
    for r in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            occupied[y + r, word + k] |= rows[r, k] << shift
            if shift > np.uint64(0):
                occupied[y + r, word + k + 1] |= rows[r, k] >> (np.uint64(64) - shift)


def _pack_bits(cells: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Rows of 64-bit words, lowest bit leftmost."""
    height, width = cells.shape
    padded = np.zeros((height, -(-width // 64) * 64), np.uint8)
    padded[:, :width] = cells
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)


@dataclass(frozen=True)
class _Chart:
    """One chart in its own frame: points (N, 2) from 0, source uv units times the chart's own scale."""

    vertices: Int64s
    points: Floats
    triangles: Int64s


def _place_all(charts: list[_Chart], scale: float, gutter_cells: float, size: int) -> list[tuple[int, int, int]] | None:
    """Turn and place of every chart at one scale (cells a unit), or None where they do not fit."""
    reach = 0.5 * gutter_cells + 0.7072  # every point of the chart is within half a diagonal of a marked cell's centre
    pad = 0.5 * gutter_cells + 1.0
    occupied = np.zeros((size, -(-size // 64) + 2), np.uint64)
    places: list[tuple[int, int, int]] = []
    row_hint = 0
    for chart in charts:
        points = chart.points * scale + pad
        width, height = np.ceil(points.max(axis=0) + pad).astype(int)
        if min(width, height) > size or max(width, height) > size:
            return None
        cells = _rasterise(points, chart.triangles, reach, width, height)
        best: tuple[int, int, int, int] | None = None
        for turn in range(4):
            turned = np.ascontiguousarray(np.rot90(cells, -turn))
            rows = _pack_bits(turned)
            x, y = _find_place(occupied, rows, turned.shape[1], size, row_hint)
            if x >= 0 and (best is None or (y + turned.shape[0], x) < best[:2]):
                best = (y + turned.shape[0], x, y, turn)
        if best is None:
            return None
        _, x, y, turn = best
        _occupy(occupied, _pack_bits(np.ascontiguousarray(np.rot90(cells, -turn))), x, y)
        places.append((x, y, turn))
        if len(charts) > MANY_CHARTS:
            row_hint = max(row_hint, y - size // 8)
    return places


def _turned(points: Floats, width: float, height: float, turn: int) -> Floats:
    """Points of a width x height box after quarter turns that keep it in the positive quadrant."""
    for _ in range(turn):
        points = np.column_stack([height - points[:, 1], points[:, 0]])
        width, height = height, width
    return points


def _least_box_angle(points: Floats) -> float:
    """Angle that turns the points' smallest bounding box upright; 0 unless that saves a twentieth of its area."""
    angles = np.linspace(0.0, np.pi / 2, 90, endpoint=False)
    c, s = np.cos(angles), np.sin(angles)
    x, y = np.outer(c, points[:, 0]) - np.outer(s, points[:, 1]), np.outer(s, points[:, 0]) + np.outer(c, points[:, 1])
    area = np.ptp(x, axis=1) * np.ptp(y, axis=1)
    best = int(area.argmin())
    return float(angles[best]) if area[best] < 0.95 * area[0] else 0.0


def _face_areas(points: Floats, faces: NDArray[np.integer]) -> Floats:
    corner = points[faces]
    p, q = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    if points.shape[1] == 2:
        return 0.5 * np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    return 0.5 * np.linalg.norm(np.cross(p, q), axis=1)


def repack_charts(
    surface: TexturedSurface,
    size_px: int,
    gutter_px: float,
    *,
    density: str = "surface",
    face_charts: Int64s | None = None,
) -> Repacked:
    """Place charts apart in the unit square without changing their shapes.

    Parameters
    ----------
    surface : TexturedSurface
        Its charts may overlap one another and lie anywhere, each being one-to-one in itself.
    size_px : int
        Texels a side of the textures to come.
    gutter_px : float
        Least distance between two charts in texels; half of it to the square's border.
    density : str
        "surface": texels follow the surface's area, chart by chart. "source": all charts keep their relative scale.
    face_charts : (F,) int64 or None
        Charts, `find_charts` where None.

    Returns
    -------
    Repacked

    Raises
    ------
    ValueError
        If `density` is neither, or the gutter alone fills the square.
    """
    if density not in ("surface", "source"):
        raise ValueError(f'density must be "surface" or "source", not {density!r}')
    if face_charts is None:
        face_charts = find_charts(surface)
    apart, uv_charts = separate_charts(surface, face_charts)
    num_charts = int(face_charts.max(initial=-1)) + 1
    if not num_charts:
        return Repacked(apart, face_charts, np.zeros(0), 0.0)
    scales = _relative_scales(apart, face_charts, density)
    charts = _cut_charts(apart, face_charts, uv_charts, scales)

    size = min(GRID_CELLS if num_charts <= MANY_CHARTS else FEW_CHARTS_CELLS, size_px)
    gutter = gutter_px * size / size_px
    order = sorted(range(num_charts), key=lambda c: (-float(np.ptp(charts[c].points, axis=0).max()), c))
    ordered = [charts[c] for c in order]
    area = sum(float(_face_areas(c.points, c.triangles).sum()) for c in charts)
    longest = max(float(np.ptp(c.points, axis=0).max()) for c in charts)
    high = min(np.sqrt(BEST_FILL * size**2 / max(area, 1e-300)), (size - gutter - 2.0) / max(longest, 1e-300))
    low, places = 0.0, None
    for step in range(SCALE_STEPS + 40):
        trial = high if step == 0 else 0.5 * (low + high)
        if low == 0.0 and step > 0:
            trial = 0.7 * high
        found = _place_all(ordered, trial, gutter, size)
        if found is not None:
            low, places = trial, found
        else:
            high = trial
        if low > 0.0 and high - low < high / 512:
            break
    if places is None:
        raise ValueError(f"{num_charts} charts with gutters of {gutter_px} texels do not fit {size_px} texels a side")

    uvs = np.zeros_like(apart.uvs)
    pad = 0.5 * gutter + 1.0
    for c, (x, y, turn) in zip(order, places, strict=True):
        points = charts[c].points * low + pad
        width, height = np.ceil(points.max(axis=0) + pad)
        uvs[charts[c].vertices] = (_turned(points, width, height, turn) + np.array([x, y])) / size
    packed = TexturedSurface(apart.positions, apart.faces, uvs, apart.face_uvs)
    coverage = float(_face_areas(uvs, packed.face_uvs).sum())
    log.info("repack: %d charts, %.1f %% of the square covered", num_charts, 100.0 * coverage)
    return Repacked(packed, face_charts, scales * low / size, coverage)


def _chart_boxes(points: Floats, faces: NDArray[np.integer], face_charts: Int64s, num_charts: int) -> Floats:
    """Size of every chart's bounding box, (C, D) float64."""
    low = np.full((num_charts, points.shape[1]), np.inf)
    high = np.full((num_charts, points.shape[1]), -np.inf)
    chart, corner = np.repeat(face_charts, 3), points[faces.ravel()]
    np.minimum.at(low, chart, corner)
    np.maximum.at(high, chart, corner)
    return high - low


def _relative_scales(surface: TexturedSurface, face_charts: Int64s, density: str) -> Floats:
    """Factor a chart on its source uvs, (C,) float64; charts without area take the median factor.

    No chart becomes longer than twice its box in space: needles in uv have no area, and would fill the atlas.
    """
    num_charts = int(face_charts.max()) + 1
    if density == "source":
        return np.ones(num_charts)
    uv_area = np.bincount(face_charts, _face_areas(surface.uvs, surface.face_uvs), num_charts)
    area_sq_m = np.bincount(face_charts, _face_areas(surface.positions, surface.faces), num_charts)
    sound = (uv_area > 1e-14) & (area_sq_m > 0.0)
    scales = np.ones(num_charts)
    if sound.any():
        scales[sound] = np.sqrt(area_sq_m[sound] / uv_area[sound])
        scales[~sound] = np.median(scales[sound])
    longest_m = np.linalg.norm(_chart_boxes(surface.positions, surface.faces, face_charts, num_charts), axis=1)
    longest_uv = np.linalg.norm(_chart_boxes(surface.uvs, surface.face_uvs, face_charts, num_charts), axis=1)
    bounded = (longest_uv > 0.0) & (longest_m > 0.0)
    scales[bounded] = np.minimum(scales[bounded], 2.0 * longest_m[bounded] / longest_uv[bounded])
    return scales


def _cut_charts(surface: TexturedSurface, face_charts: Int64s, uv_charts: Int64s, scales: Floats) -> list[_Chart]:
    """Every chart in its own frame, turned upright where that makes its box smaller, scaled by its factor."""
    vertex_order, face_order = np.argsort(uv_charts, kind="stable"), np.argsort(face_charts, kind="stable")
    num_charts = len(scales)
    vertex_first = np.searchsorted(uv_charts[vertex_order], np.arange(num_charts + 1))
    face_first = np.searchsorted(face_charts[face_order], np.arange(num_charts + 1))
    local = np.empty(len(uv_charts), np.int64)
    local[vertex_order] = np.arange(len(uv_charts)) - np.repeat(vertex_first[:-1], np.diff(vertex_first))
    charts = []
    for c in range(num_charts):
        vertices = vertex_order[vertex_first[c] : vertex_first[c + 1]]
        points = surface.uvs[vertices] * scales[c]
        angle = _least_box_angle(points)
        if angle:
            cos, sin = np.cos(angle), np.sin(angle)
            points = points @ np.array([[cos, sin], [-sin, cos]])
        triangles = local[surface.face_uvs[face_order[face_first[c] : face_first[c + 1]]]]
        charts.append(_Chart(vertices, points - points.min(axis=0), triangles))
    return charts
