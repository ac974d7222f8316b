"""The state of one run: a surface in normalised units, ready for the kernels, and its way back to metres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from preprocess.arrays import Floats
from preprocess.decimate import rules
from preprocess.decimate.collapse import run
from preprocess.decimate.deviation import CORNERS, CORNERS_STRIDE
from preprocess.decimate.deviation_samples import (
    FIRST_POSE,
    WEIGHT_COLUMN,
    Witnesses,
    choose_poses,
    make_witnesses,
    no_witnesses,
)
from preprocess.decimate.levels import DecimateOptions, Lod, Repairs, Strictness
from preprocess.decimate.lower_bound import count_floor
from preprocess.decimate.quadrics import SIZE, accumulate_faces
from preprocess.decimate.refinement import polish
from preprocess.decimate.rules import Mesh
from preprocess.decimate.seam_precision import straighten_within, written_tolerance_uv
from preprocess.decimate.topology import TAIL, TWIN, WEDGE, HalfEdges, build_half_edges, source_uvs
from preprocess.mesh.skinning import Skinning, make_skinning
from preprocess.mesh.surface import TexturedSurface
from preprocess.mesh.texels import sample_bilinear
from preprocess.mesh.vertex_cache import reorder

# Faces may turn by at most about 78 degrees in one collapse.
MIN_NORMAL_DOT = 0.2
# Uv distance, summed over all collapses, by which a seam may leave its line at an exact level: float64's rounding.
ROUNDING_UV = 1e-9
# Least height of a triangle over its longest side, in uv of the unit square: far above the rounding of float32 uvs.
MIN_UV_HEIGHT = 4e-7
# Least height of a triangle over its longest side in space, as a fraction of that side.
MIN_SHAPE = 1e-3
# How much an open boundary resists, against a strip of surface as wide as the boundary edge is long.
BOUNDARY_WEIGHT = 1.0
# Faces around one collapse that are looked at for their witnesses; more leave them unheard.
FAN_SIZE = 256
# Times every edge and vertex is tried when a level is polished.
POLISH_SWEEPS = 2

_STRICT = {
    Strictness.NONE: rules.STRICT_NONE,
    Strictness.SHAPE: rules.STRICT_SHAPE,
    Strictness.SEAMLESS: rules.STRICT_SEAMLESS,
}


def _pose_quadrics(posed: Floats, faces: NDArray[np.int64]) -> Floats:
    """Area-weighted position quadrics of the faces of one pose, a third to each corner's vertex, (V, 10) float64."""
    corners = posed[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    norms = np.linalg.norm(normals, axis=1)
    weights = 1.0 / (6.0 * np.where(norms > 0, norms, np.inf))  # area / 3 over the square of the normal's length
    planes = np.c_[normals, -np.einsum("fi,fi->f", normals, corners[:, 0])]
    rows, columns = np.array([0, 0, 0, 1, 1, 2, 0, 1, 2, 3]), np.array([0, 1, 2, 1, 2, 2, 3, 3, 3, 3])
    terms = weights[:, None] * planes[:, rows] * planes[:, columns]
    sums = [np.bincount(faces.ravel(), np.repeat(term, 3), len(posed)) for term in terms.T]
    return np.stack(sums, axis=1)


def _posed(matrices: Floats, xyz: Floats, centre: Floats, scale: float) -> Floats:
    """Normalised positions in each pose, (P, V, 3)."""
    metres = np.einsum("pvij,vj->pvi", matrices[..., :3], xyz * scale + centre) + matrices[..., 3]
    result: Floats = (metres - centre) / scale
    return result


def _pose(
    half_edges: HalfEdges,
    uv: Floats,
    xyz: Floats,
    centre: Floats,
    scale: float,
    poses: NDArray[np.floating] | None,
    watched: bool,
) -> tuple[Floats, Witnesses]:
    """Matrices of the vertices in each pose (P, V, 3, 4), those that witnesses follow first; and the witnesses."""
    matrices = np.zeros((0, len(xyz), 3, 4)) if poses is None else np.asarray(poses, np.float64)
    matrices = matrices[:, half_edges.vertex_source] if len(matrices) else matrices
    if not watched:
        return matrices, no_witnesses(half_edges.num_faces)
    posed = _posed(matrices, xyz, centre, scale)
    chosen = choose_poses(posed, xyz, half_edges.tail[: 3 * half_edges.num_faces].reshape(-1, 3))
    others = np.setdiff1d(np.arange(len(matrices)), chosen)
    witnesses = make_witnesses(half_edges, uv, np.concatenate([xyz[None], posed[chosen]]))
    return matrices[np.r_[chosen, others]], witnesses


def _seam_tolerance_uv(uvs: Floats, options: DecimateOptions) -> float:
    """How far seams may be from straight and matched and still count as that."""
    if options.strict is Strictness.NONE:
        return 0.0
    return written_tolerance_uv(uvs) if options.seam_tolerance_uv is None else options.seam_tolerance_uv


# Arrays of a mesh that no kernel writes to: copies of a state share them.
SHARED_ARRAYS = {"texture", "points"}


@dataclass(frozen=True)
class Engine:
    """A run in progress. The arrays of `mesh` change in place as `run_to` is called.

    Attributes
    ----------
    mesh : Mesh
    half_edges : HalfEdges
        As built.
    repairs : Repairs
    centre_m : (3,) float64
    scale_m : float
        Metres of one normalised unit.
    metres_per_uv : float
        Square root of the surface's area over its area in uv.
    position_texture : (H, W, 3) float64, metres, or None
    skinning : Skinning
        Matrices in each pose, in the order of the mesh's.
    """

    mesh: Mesh
    half_edges: HalfEdges
    repairs: Repairs
    centre_m: Floats
    scale_m: float
    metres_per_uv: float
    position_texture: Floats | None
    skinning: Skinning

    @property
    def shows_surface(self) -> bool:
        """Whether vertices are drawn where the surface has them, whatever the position texture says."""
        return self.position_texture is None or bool(self.mesh.settings[rules.LIFT] > 0.0)

    @property
    def num_faces(self) -> int:
        """Faces left."""
        return int(self.mesh.counter[rules.FACES_LEFT])

    def run_to(self, target_faces: int, max_cost: float = np.inf) -> None:
        """Collapse until that many faces are left, the next collapse costs more, or none is legal."""
        run(self.mesh, target_faces, max_cost, np.zeros(0, np.int64))

    def run_within(self, error_m: float) -> None:
        """Collapse as long as the next costs no more than an average star of faces that deviates by an error.

        A collapse that brings a sample further off than that costs more (`rules.PEAK`).
        """
        square = (error_m / self.scale_m) ** 2
        before = self.num_faces + 1
        while self.num_faces < before:
            before = self.num_faces
            self.run_to(1, float(self.mesh.settings[rules.PEAK]) / before * square)

    def copy(self) -> Engine:
        """The same state, to go on from twice."""
        arrays = self.mesh._asdict()
        changing = {name: array.copy() for name, array in arrays.items() if name not in SHARED_ARRAYS}
        return replace(self, mesh=self.mesh._replace(**changing))

    def predict_floor(self) -> int:
        """Lower bound of the faces that exact collapses leave; only before the first collapse."""
        uvs = self.mesh.uv
        return count_floor(self.half_edges, uvs, float(self.mesh.settings[rules.SEAM_TOLERANCE]))

    def relax(self, tolerance_uv: float) -> None:
        """Let seams stray that far from their lines from now on, and look at every edge again."""
        self.mesh.settings[rules.SEAM_TOLERANCE] = tolerance_uv
        self.mesh.settings[rules.RELAXED] = 1.0
        self._forget_prices()

    def polish(self) -> None:
        """Turn edges and move vertices to where the surface is nearer to the full mesh; seams stay where they are."""
        if not self.mesh.settings[rules.PEAK] > 0.0:
            return  # nobody to say what is better
        self._pose_again()
        polish(self.mesh, POLISH_SWEEPS, np.zeros(3, np.int64))
        self._forget_prices()

    def weigh_witnesses(self, weights: Floats) -> None:
        """Let the squared departure of each witness count so much from now on, (S,); before, all count 1."""
        self.mesh.points[:, WEIGHT_COLUMN] = weights

    def witness_places(self) -> Floats:
        """Where the witnesses are in bind pose, metres, (S, 3)."""
        return self.mesh.points[:, FIRST_POSE : FIRST_POSE + 3] * self.scale_m + self.centre_m

    def _pose_again(self) -> None:
        """Put every vertex where its own weights put it in each pose: collapses and steps know that only nearly."""
        mesh = self.mesh
        if not len(self.skinning.matrices):
            return
        vertices, wedges = self._owners()
        matrices = self.skinning.at(mesh.uv[wedges])
        posed = _posed(matrices, mesh.xyz[vertices], self.centre_m, self.scale_m)
        mesh.pose[vertices, :, : rules.POSE_ROTATION] = posed.transpose(1, 0, 2)
        rotations = matrices[..., :3].transpose(1, 0, 2, 3).reshape(len(vertices), -1, 9)
        mesh.pose[vertices, :, rules.POSE_ROTATION : rules.POSE_QUADRIC] = rotations

    def _owners(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The vertices that are left and a wedge of each."""
        corners = self.mesh.links[: 3 * self.half_edges.num_faces]
        corners = corners[corners[:, TAIL] >= 0]
        vertices, first = np.unique(corners[:, TAIL], return_index=True)
        return vertices, corners[first, WEDGE]

    def _forget_prices(self) -> None:
        mesh = self.mesh
        mesh.links[:, rules.PLACE] = -1
        mesh.links[:, rules.BLOCKED] = 0
        mesh.vertices[:, rules.NUM_BLOCKED] = 0
        mesh.counter[rules.HEAP_SIZE] = 0
        mesh.counter[rules.PRICED] = 0

    def drop_parts(self, size_m: float) -> tuple[int, float]:
        """Remove whole parts whose bounding box has a diagonal of at most `size_m`, but never the largest.

        Returns
        -------
        int
            Parts removed.
        float
            Diagonal of the largest of them, metres.
        """
        mesh, num_faces = self.mesh, self.half_edges.num_faces
        alive = np.flatnonzero(mesh.links[: 3 * num_faces : 3, TAIL] >= 0)
        faces = mesh.links[3 * alive[:, None] + np.arange(3), TAIL]
        num_vertices = len(mesh.xyz)
        ends = faces[:, :2].ravel(), faces[:, 1:].ravel()
        graph = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(num_vertices, num_vertices))
        num_parts, part = connected_components(graph, directed=False)
        low, high = np.full((num_parts, 3), np.inf), np.full((num_parts, 3), -np.inf)
        used = np.unique(faces)
        np.minimum.at(low, part[used], mesh.xyz[used])
        np.maximum.at(high, part[used], mesh.xyz[used])
        parts = np.unique(part[used])
        sizes = np.zeros(num_parts)
        sizes[parts] = np.linalg.norm(high[parts] - low[parts], axis=1) * self.scale_m
        candidates = parts[(sizes[parts] <= size_m) & (parts != sizes.argmax())]
        small = np.zeros(num_parts, bool)
        small[candidates] = True
        gone = np.append(small[part], False)[mesh.links[:, TAIL]] & (mesh.links[:, TAIL] >= 0)
        gone = np.repeat(gone.reshape(-1, 3).any(axis=1), 3)  # with their virtual faces
        mesh.links[gone, TAIL] = -1
        mesh.links[gone, TWIN] = -1
        mesh.counter[rules.FACES_LEFT] -= int(gone[: 3 * num_faces].sum()) // 3
        self._forget_prices()
        return len(candidates), float(sizes[candidates].max(initial=0.0))

    @property
    def deviation_uv(self) -> float:
        """How far seams have strayed from their lines, uv."""
        alive = self.mesh.links[:, TAIL] >= 0
        return float(self.mesh.deviation[alive].max(initial=0.0))

    def blocked(self) -> dict[str, int]:
        """Number of edges that cannot collapse, by rule."""
        counts = np.zeros(8, np.int64)
        run(self.mesh, self.num_faces, 0.0, counts)
        return {name: int(counts[rule]) for rule, name in rules.RULE_NAMES.items() if counts[rule]}

    def snapshot(self) -> Lod:
        """What is left, as compact arrays in metres, in an order that suits a GPU's caches."""
        mesh, half_edges = self.mesh, self.half_edges
        num_faces = half_edges.num_faces
        alive = np.flatnonzero(mesh.links[: 3 * num_faces : 3, TAIL] >= 0)
        corners = 3 * alive[:, None] + np.arange(3)
        faces, face_uvs = mesh.links[corners, TAIL], mesh.links[corners, WEDGE]
        face_order, vertices, wedges = reorder(faces, face_uvs)
        faces, face_uvs = faces[face_order], face_uvs[face_order]
        new_vertex = np.zeros(len(mesh.xyz), np.int32)
        new_vertex[vertices] = np.arange(len(vertices))
        new_wedge = np.zeros(len(mesh.uv), np.int32)
        new_wedge[wedges] = np.arange(len(wedges))
        owners = np.zeros(len(mesh.xyz), np.int64)
        owners[faces[::-1].ravel()] = face_uvs[::-1].ravel()
        if self.position_texture is None or self.shows_surface:
            positions = mesh.xyz[vertices] * self.scale_m + self.centre_m
        else:
            positions = sample_bilinear(self.position_texture, mesh.uv[owners[vertices]])
        return Lod(
            uvs=mesh.uv[wedges],
            face_uvs=new_wedge[face_uvs],
            faces=new_vertex[faces],
            canonical_uvs=new_wedge[owners[vertices]],
            face_source=half_edges.face_source[alive[face_order]],
            positions=positions,
        )


def make_engine(
    surface: TexturedSurface,
    options: DecimateOptions,
    position_texture: NDArray[np.floating] | None = None,
    poses: NDArray[np.floating] | None = None,
    face_groups: NDArray[np.integer] | None = None,
) -> Engine:
    """Set up a run.

    Parameters
    ----------
    surface : TexturedSurface
    options : DecimateOptions
    position_texture : (H, W, 3) float, metres, or None
        What the vertices will be drawn at; with None they are drawn where the run puts them.
    poses : (P, V, 3, 4) float or None
        Skinning matrix of every surface vertex in each pose that counts besides the bind pose.
    face_groups : (F,) int or None
        See `topology.build_half_edges`.

    Raises
    ------
    InputError
        See `topology.build_half_edges`.
    """
    half_edges, repairs = build_half_edges(surface, face_groups)
    num_faces, num_half_edges = half_edges.num_faces, len(half_edges.tail)
    num_vertices = len(half_edges.vertex_source)
    used = surface.positions[half_edges.vertex_source]
    low, high = used.min(axis=0), used.max(axis=0)
    centre, scale = 0.5 * (low + high), float(np.linalg.norm(high - low)) or 1.0
    texture = np.zeros((0, 0, 3)) if position_texture is None else (np.asarray(position_texture) - centre) / scale
    written_uv = source_uvs(half_edges, surface)
    uv = straighten_within(half_edges, used, written_uv, _seam_tolerance_uv(written_uv, options))
    xyz = np.ascontiguousarray((used - centre) / scale)

    corner_uv = uv[half_edges.wedge[: 3 * num_faces].reshape(-1, 3)]
    edges = np.diff(corner_uv, axis=1)
    uv_area2 = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    corner_xyz = xyz[half_edges.tail[: 3 * num_faces].reshape(-1, 3)]
    sides = np.diff(corner_xyz, axis=1)
    area2 = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()
    uv_total = float(np.abs(uv_area2).sum())
    metres_per_uv = float(np.sqrt(area2 / uv_total)) if uv_total > 0 and area2 > 0 else 1.0
    extent_uv = float(np.ptp(uv, axis=0).max()) or 1.0

    settings = np.zeros(9)
    settings[rules.UV_SCALE] = max(options.uv_weight_rel, 1e-6) * metres_per_uv
    settings[rules.SEAM_TOLERANCE] = ROUNDING_UV * max(extent_uv, 1.0)
    settings[rules.STRICT] = _STRICT[options.strict]
    settings[rules.MIN_NORMAL_DOT] = MIN_NORMAL_DOT
    settings[rules.MIN_UV_HEIGHT] = MIN_UV_HEIGHT * min(extent_uv, 1.0)
    settings[rules.MIN_SHAPE] = MIN_SHAPE
    settings[rules.LIFT] = options.lifted
    corners = half_edges.tail[: 3 * num_faces].reshape(-1, 3)
    matrices, witnesses = _pose(half_edges, uv, xyz, centre, scale, poses, bool(options.peak_weight))
    # Two wedges' quadrics have four faces' area between them, in each pose.
    settings[rules.PEAK] = (options.peak_weight or 0.0) * 2.0 * float(area2) * (1 + len(matrices))
    links = np.full((num_half_edges, 6), -1, np.int64)
    links[:, TAIL], links[:, WEDGE], links[:, TWIN] = half_edges.tail, half_edges.wedge, half_edges.twin
    links[:, rules.BLOCKED] = links[:, rules.WEIGHED] = 0
    vertices = np.zeros((num_vertices + 1, 4), np.int64)
    vertices[:, rules.OUT], vertices[:, rules.SILHOUETTES] = half_edges.out, half_edges.num_silhouettes
    counter = np.zeros(8, np.int64)
    counter[rules.FACES_LEFT] = num_faces
    if position_texture is not None and not options.lifted:
        first_corner = np.unique(half_edges.tail[: 3 * num_faces], return_index=True)[1]
        xyz = sample_bilinear(texture, uv[half_edges.wedge[first_corner]])
    mesh = Mesh(
        links=links,
        vertices=vertices,
        xyz=xyz,
        uv=uv,
        quadric=np.zeros((len(uv), SIZE)),
        deviation=np.zeros(num_half_edges),
        faces=np.c_[np.where(uv_area2 < 0, -1, 1), witnesses.faces],
        texture=np.ascontiguousarray(texture, np.float64),
        pose=np.zeros((num_vertices, len(matrices), rules.POSE_SIZE)),
        work=np.zeros((24, 10)),
        settings=settings,
        counter=counter,
        heap_cost=np.zeros(num_half_edges),
        heap_item=np.zeros(num_half_edges, np.int64),
        points=witnesses.points,
        witnesses=np.c_[witnesses.following, np.zeros((len(witnesses.points), 2), np.int64)],
        fan=np.zeros((FAN_SIZE, CORNERS + CORNERS_STRIDE * (1 + len(matrices)))),
    )
    for p, (matrix, posed) in enumerate(zip(matrices, _posed(matrices, xyz, centre, scale), strict=True)):
        mesh.pose[:, p, : rules.POSE_ROTATION] = posed
        mesh.pose[:, p, rules.POSE_ROTATION : rules.POSE_QUADRIC] = matrix[..., :3].reshape(-1, 9)
        mesh.pose[:, p, rules.POSE_QUADRIC :] = _pose_quadrics(posed, corners)
    accumulate_faces(
        mesh.links,
        num_faces,
        mesh.xyz,
        mesh.uv,
        settings[rules.UV_SCALE],
        BOUNDARY_WEIGHT,
        mesh.quadric,
        np.zeros((3, 5)),
        np.zeros((2, 5)),
    )
    drawn = None if position_texture is None else np.asarray(position_texture, np.float64)
    skinning = make_skinning(matrices, corners, corner_uv)
    return Engine(mesh, half_edges, repairs, centre, scale, metres_per_uv * scale, drawn, skinning)
