"""Stage "weight details": quadtrees of finer cells where the weight map is too coarse for the surface.

A weight map (paper, section 8) must be fine where vertices are dense or the weights of neighbouring charts meet, and
may be coarse elsewhere. Making all of it as fine as its worst place takes ten times the memory. So the seamless map
stays small, and each of its 2 x 2 cells that is wrong at a vertex, or too far off between vertices, gets weights of its
own at its corners: fitted by least squares to the vertices in it, then to the surface between them. What is still wrong
is divided into quarters, which are fitted in turn; those that can share their weights do (shared_leaves.py).
Letters in shapes: N points, J joints, P poses, S squares, L leaves, K joints a corner.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.fit.shared_records import share_corners
from preprocess.mesh.seams import Seams
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear, uv_to_px
from preprocess.numerics.jit import fixed_memory_entry
from runtime.asset.weight_quadtree import WeightDetails, build_quadtree
from runtime.asset.weight_stack import WEIGHT_STEPS, pack_weights, unpack_pairs, unpack_weights

DEEPEST = 8  # a vertex a leaf, wherever two can be told apart
WEIGHT_ALLOWED = 60.0  # how far any weight may be off, times how far points may be: for poses that nobody sampled
VERTEX_PULL = 1e4  # of a vertex in a fit, against a point between vertices
HOLD = 1e-2  # of the coarser weights, where nothing else says what a corner has
ALTERNATIONS = 4  # between the points' own weights and partitions of unity
JUMP_POINTS = 32  # on every seam edge
BORDER_PX, FINEST = 0.02, 2**DEEPEST  # vertices so close to a border are fitted on both sides of it


@dataclass(frozen=True)
class WeightPoints:
    """Points of the surface with the weights that they should have.

    Attributes
    ----------
    uvs : (N, 2) float64
    weights : (N, J) float64
    positions : (N, 3) float64
    is_vertex : (N,) bool
        Whether a level has a vertex there.
    allowed_rel : (N,) float64
        How far they may be off in a pose, of the diagonal.
    """

    uvs: Floats
    weights: Floats
    positions: Floats
    is_vertex: NDArray[np.bool_]
    allowed_rel: Floats

    def rows(self, which: NDArray[np.intp] | NDArray[np.bool_]) -> WeightPoints:
        """Some of the points."""
        return WeightPoints(*(getattr(self, part.name)[which] for part in dataclasses.fields(self)))


def pose_moves(poses: Floats, diagonal_m: float) -> Floats:
    """What joints do in poses (P, J, 4, 4): rows of their matrices over the diagonal, (J, P * 12)."""
    return poses[:, :, :3].transpose(1, 0, 2, 3).reshape(poses.shape[1], -1) / max(diagonal_m, 1e-30)


@fixed_memory_entry
def _find_exceeded(wrong, positions, allowed_rel, moves, exceeded):  # type: ignore[no-untyped-def]
    """`_exceeded`, in place; moves are (J, P, 3, 4), and most weights are right."""
    num_joints, num_poses = moves.shape[:2]
    for n in range(len(wrong)):
        allowed = allowed_rel[n]
        largest = 0.0
        for j in range(num_joints):
            largest = max(largest, abs(wrong[n, j]))
        exceeded[n] = largest > WEIGHT_ALLOWED * allowed
        for p in range(num_poses if largest > 0.0 and not exceeded[n] else 0):
            moved_sq = 0.0
            for row in range(3):
                moved = 0.0
                for j in range(num_joints):
                    if wrong[n, j] != 0.0:
                        along = moves[j, p, row, 3]
                        for k in range(3):
                            along += moves[j, p, row, k] * positions[n, k]
                        moved += wrong[n, j] * along
                moved_sq += moved * moved
            if moved_sq > allowed * allowed:
                exceeded[n] = True
                break


def _exceeded(wrong: Floats, points: WeightPoints, moves: Floats) -> NDArray[np.bool_]:
    """Whether errors of weights, (N, J), are more than allowed at points: (N,) bool."""
    exceeded = np.zeros(len(wrong), np.bool_)
    matrices = moves.reshape(len(moves), -1, 3, 4)
    _find_exceeded(
        np.ascontiguousarray(wrong), np.ascontiguousarray(points.positions), np.ascontiguousarray(points.allowed_rel),
        np.ascontiguousarray(matrices), exceeded,
    )  # fmt: skip
    return exceeded


def _shares(fraction: Floats) -> Floats:
    """What the corners (0,0), (1,0), (0,1), (1,1) of a square count at places in it, (N, 4)."""
    x, y = fraction.T
    return np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)


def _rounded(corners: Floats) -> Floats:
    """Weights (S, 4, J) as they are stored."""
    if not len(corners):
        return corners
    packed = pack_weights(corners)
    return unpack_weights(packed.stack, packed.size, corners.shape[2])


def _fit_squares(corners: Floats, square: NDArray[np.int64], fraction: Floats, points: WeightPoints) -> Floats:
    """Weights at the corners of squares, (S, 4, J), that suit the points in them, as partitions of unity."""
    num_squares, _, num_joints = corners.shape
    shares = _shares(fraction)
    pull = np.where(points.is_vertex, VERTEX_PULL, 1.0)
    columns = (4 * square[:, None] + np.arange(4)).ravel()
    rows = np.repeat(np.arange(len(square)), 4)
    blend = sp.csr_matrix((shares.ravel(), (rows, columns)), shape=(len(square), 4 * num_squares))
    pulled = sp.csr_matrix(((shares * pull[:, None]).ravel(), (columns, rows)), shape=blend.shape[::-1])
    products = (pull[:, None, None] * shares[:, :, None] * shares[:, None, :]).reshape(len(square), 16)
    normal = np.stack([np.bincount(square, products[:, k], num_squares) for k in range(16)], axis=1)
    inverse = np.linalg.inv(normal.reshape(-1, 4, 4) + HOLD * np.eye(4))

    present = np.zeros((num_squares, num_joints), bool)
    point, joint = np.nonzero(points.weights)
    present[square[point], joint] = True
    present |= ~present.any(axis=1, keepdims=True)
    fitted = corners * present[:, None]
    for _ in range(ALTERNATIONS):
        left = points.weights - blend @ fitted.reshape(-1, num_joints)
        change = inverse @ np.asarray(pulled @ left).reshape(num_squares, 4, num_joints)
        fitted = np.clip(fitted + change * present[:, None], 0.0, None)
        fitted /= np.maximum(fitted.sum(axis=2, keepdims=True), 1e-12)
    return _rounded(fitted)


def _quarters(corners: Floats) -> Floats:
    """Corners of the quarters of squares, (S, 4, J) to (4 S, 4, J)."""
    blends = np.array([_shares(np.array([(x, y)]) / 2.0)[0] for y in range(3) for x in range(3)])
    grid = np.einsum("gk,skj->sgj", blends, corners)
    of_quarter = np.array([[3 * (y + b) + x + a for b in (0, 1) for a in (0, 1)] for y in (0, 1) for x in (0, 1)])
    result: Floats = grid[:, of_quarter].reshape(-1, 4, corners.shape[2])
    return result


def _on_both_sides(points: WeightPoints, size: tuple[int, int]) -> WeightPoints:
    """Vertices at a border of squares once more, a little to each side: 32-bit uvs may fall on either."""
    px = uv_to_px(points.uvs, *size) * FINEST
    close = (np.abs(px - np.rint(px)) < BORDER_PX).any(axis=1) & points.is_vertex
    extra = points.rows(np.repeat(np.flatnonzero(close), 4))
    shift = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)]) * (BORDER_PX / FINEST)
    moved = extra.uvs + np.tile(shift, (int(close.sum()), 1)) / size
    extra = dataclasses.replace(extra, uvs=moved)
    pairs = ((getattr(points, part.name), getattr(extra, part.name)) for part in dataclasses.fields(points))
    return WeightPoints(*(np.concatenate(pair) for pair in pairs))


def _cells(uvs: Floats, size: tuple[int, int]) -> tuple[NDArray[np.int64], Floats]:
    """Column and row of the cell that each point reads, (N, 2), and its place there, (N, 2)."""
    last = np.array(size) - 1
    px = np.clip(uv_to_px(uvs, *size), 0.0, last)
    corner = np.minimum(np.floor(px).astype(np.int64), np.maximum(last - 1, 0))
    return corner, px - corner


def detail_weights(stored: Floats, points: WeightPoints, moves: Floats) -> WeightDetails:
    """Leaves where the map is wrong by more than the points allow.

    Parameters
    ----------
    stored : (H, W, J) float64
        The weight map as stored; at least 2 x 2.
    points : WeightPoints
    moves : (J, P * 12) float64
        From `pose_moves`.

    Returns
    -------
    WeightDetails
        Possibly of no leaves.
    """
    height, width = stored.shape[:2]
    size = (width, height)
    points = _on_both_sides(points, size)
    sampled = sample_bilinear(stored, points.uvs)
    cell, fraction = _cells(points.uvs, size)
    number = cell[:, 1] * (width - 1) + cell[:, 0]
    squares = np.unique(number[_exceeded(sampled - points.weights, points, moves)])
    inside = np.flatnonzero(np.isin(number, squares))
    points, fraction = points.rows(inside), fraction[inside]
    square = np.searchsorted(squares, number[inside])
    row, column = np.divmod(squares, width - 1)
    places = np.stack([column, row], axis=1)
    corners = np.stack([stored[row + y, column + x] for y in (0, 1) for x in (0, 1)], axis=1)

    all_points, point = points, np.arange(len(square))
    leaf, shares = np.zeros(len(square), np.int64), np.zeros((len(square), 4))  # of each point, in the end
    num_leaves = 0
    depths: list[NDArray[np.int64]] = []
    leaf_places: list[NDArray[np.int64]] = []
    leaves: list[Floats] = []
    for depth in range(DEEPEST + 1):
        fitted = _fit_squares(corners, square, fraction, points)
        wrong = np.einsum("nk,nkj->nj", _shares(fraction), fitted[square]) - points.weights
        divided = np.zeros(len(places), bool)
        if depth < DEEPEST:
            divided[square[_exceeded(wrong, points, moves)]] = True
        whole = ~divided[square]
        leaf[point[whole]] = (num_leaves - 1 + np.cumsum(~divided))[square[whole]]
        shares[point[whole]] = _shares(fraction[whole])
        num_leaves += int((~divided).sum())
        depths.append(np.full(int((~divided).sum()), depth, np.int64))
        leaf_places.append(places[~divided])
        leaves.append(fitted[~divided])
        if not divided.any():
            break
        within = divided[square]
        points, fraction, point = points.rows(within), 2.0 * fraction[within], point[within]
        quarter = np.minimum(fraction.astype(np.int64), 1)
        fraction = fraction - quarter
        of_divided = np.cumsum(divided) - 1
        square = 4 * of_divided[square[within]] + 2 * quarter[:, 1] + quarter[:, 0]
        steps = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        places = (2 * places[divided][:, None] + steps).reshape(-1, 2)
        corners = _quarters(fitted[divided])
    fitted, all_depths, all_places = np.concatenate(leaves), np.concatenate(depths), np.concatenate(leaf_places)

    def suits(some: NDArray[np.int64], leaves_of: NDArray[np.int64]) -> NDArray[np.bool_]:
        wrong = np.einsum("nk,nkj->nj", shares[some], fitted[leaves_of]) - all_points.weights[some]
        return ~_exceeded(wrong, all_points.rows(some), moves)

    num_vertices = np.bincount(leaf, all_points.is_vertex, num_leaves).astype(np.int64)
    joints, weights = _as_lists(share_corners(fitted, all_places, all_depths, leaf, num_vertices, suits))
    return WeightDetails(all_depths, all_places, joints, weights)


def _as_lists(corners: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Joints and weights (of 255) of leaves, (L, 4, K) each."""
    if not len(corners):
        return np.zeros((0, 4, 1), np.int64), np.zeros((0, 4, 1), np.int64)
    packed = pack_weights(corners)
    joints, weights = unpack_pairs(packed.stack, packed.size)
    return joints[..., : packed.slots], weights[..., : packed.slots]


def dense_leaves(details: WeightDetails, num_joints: int) -> Floats:
    """Weights at the leaves' corners, (L, 4, J) float64."""
    dense = np.zeros((*details.joints.shape[:2], num_joints))
    leaf, corner = np.arange(len(dense))[:, None, None], np.arange(4)[:, None]
    np.add.at(dense, (leaf, corner, details.joints), details.weights / WEIGHT_STEPS)
    return dense


def sample_weights(stored: Floats, details: WeightDetails, uvs: Floats) -> Floats:
    """Weights at places of the atlas as the shaders read them, the twin of `find_record` in skinning.glsl.

    Parameters
    ----------
    stored : (H, W, J) float64
        The map, from `unpack_weights`.
    details : WeightDetails
    uvs : (N, 2) float

    Returns
    -------
    (N, J) float64
    """
    height, width, num_joints = stored.shape
    tree = build_quadtree(details)
    num_leaves = len(details.depths)
    columns = max(width - 1, 1)
    node_of_cell = np.full(columns * max(height - 1, 1), -1, np.int64)
    node_of_cell[tree.cells[:, 1] * columns + tree.cells[:, 0]] = tree.cell_nodes
    uvs = np.asarray(uvs, np.float64)
    cell, fraction = _cells(uvs, (width, height))
    node = node_of_cell[cell[:, 1] * columns + cell[:, 0]]
    while (node >= num_leaves).any():
        below = np.flatnonzero(node >= num_leaves)
        quarter = (fraction[below] >= 0.5).astype(np.int64)
        fraction[below] = 2.0 * fraction[below] - quarter
        node[below] = tree.children[node[below] - num_leaves, 2 * quarter[:, 1] + quarter[:, 0]]
    sampled = sample_bilinear(stored, uvs)
    fine = np.flatnonzero(node >= 0)
    leaves = dense_leaves(details, num_joints)
    sampled[fine] = np.einsum("nk,nkj->nj", _shares(fraction[fine]), leaves[node[fine]])
    return sampled


def measure_jump(stored: Floats, details: WeightDetails, surface: TexturedSurface, seams: Seams) -> tuple[float, float]:
    """Jump of weights across seams, details and all: rms over the seams' length of its norm, and the largest.

    Sampled, since details end anywhere along an edge.

    Parameters
    ----------
    stored : (H, W, J) float64
        The map, from `unpack_weights`.
    details : WeightDetails
    surface : TexturedSurface
    seams : Seams
        Of the surface.
    """
    if not len(seams.uv_pairs):
        return 0.0, 0.0
    share = ((np.arange(JUMP_POINTS) + 0.5) / JUMP_POINTS)[:, None]
    ends = surface.uvs[seams.uv_pairs]  # seam, side, end
    places = ends[:, :, None, 0] * (1.0 - share) + ends[:, :, None, 1] * share
    sampled = sample_weights(stored, details, places.reshape(-1, 2)).reshape(*places.shape[:3], -1)
    apart = sampled[:, 0] - sampled[:, 1]
    mean_sq = (apart**2).sum(axis=2).mean(axis=1)
    rms = np.sqrt((mean_sq * seams.lengths_m).sum() / max(float(seams.lengths_m.sum()), 1e-30))
    return float(rms), float(np.abs(apart).max())
