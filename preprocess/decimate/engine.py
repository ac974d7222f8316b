"""The state of one run: a surface in normalised units, ready for the kernels, and its way back to metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.decimate import rules
from preprocess.decimate.collapse import census, price_all, run
from preprocess.decimate.heap import make_heap
from preprocess.decimate.jit import entry
from preprocess.decimate.lod import DecimateOptions, Lod, Repairs, Strictness
from preprocess.decimate.placement import drawn_position
from preprocess.decimate.quadrics import POSITION_SIZE, SIZE, accumulate_faces
from preprocess.decimate.rules import Mesh
from preprocess.decimate.topology import HalfEdges, build_half_edges
from preprocess.mesh import Floats, TexturedSurface

# Faces may turn by at most about 78 degrees in one collapse.
MIN_NORMAL_DOT = 0.2
# Least height of a triangle over its longest side, in uv of the unit square: far above the rounding of float32 uvs.
MIN_UV_HEIGHT = 4e-7
# Least height of a triangle over its longest side in space, as a fraction of that side.
MIN_SHAPE = 1e-3
# How much an open boundary resists, against a strip of surface as wide as the boundary edge is long.
BOUNDARY_WEIGHT = 1.0

_STRICT = {
    Strictness.NONE: rules.STRICT_NONE,
    Strictness.SHAPE: rules.STRICT_SHAPE,
    Strictness.SEAMLESS: rules.STRICT_SEAMLESS,
}


@entry
def _draw_vertices(m, num_vertices):
    """Move every surface vertex to where it is drawn."""
    placed = np.zeros(num_vertices, np.uint8)
    for h in range(3 * len(m.orientation)):
        v = m.tail[h]
        if placed[v] == 0:
            placed[v] = 1
            m.xyz[v, 0], m.xyz[v, 1], m.xyz[v, 2] = drawn_position(m, m.uv[m.wedge[h], 0], m.uv[m.wedge[h], 1])


@entry
def _accumulate_poses(m, num_faces):
    """Area-weighted position quadrics of the posed faces, a third to each corner's vertex."""
    for p in range(m.pose_xyz.shape[1]):
        for f in range(num_faces):
            i, j, k = m.tail[3 * f], m.tail[3 * f + 1], m.tail[3 * f + 2]
            a, b, c = m.pose_xyz[i, p], m.pose_xyz[j, p], m.pose_xyz[k, p]
            ex, ey, ez, fx, fy, fz = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
            nx, ny, nz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
            norm = np.sqrt(nx * nx + ny * ny + nz * nz)
            if norm == 0.0:
                continue
            weight = 1.0 / (6.0 * norm)  # area / 3 over the square of the normal's length
            d = -(nx * a[0] + ny * a[1] + nz * a[2])
            for v in (i, j, k):
                q = m.pose_quadric[v, p]
                q[0] += weight * nx * nx
                q[1] += weight * nx * ny
                q[2] += weight * nx * nz
                q[3] += weight * ny * ny
                q[4] += weight * ny * nz
                q[5] += weight * nz * nz
                q[6] += weight * nx * d
                q[7] += weight * ny * d
                q[8] += weight * nz * d
                q[9] += weight * d * d


@dataclass(frozen=True)
class Engine:
    """A run in progress. The arrays of `mesh` change in place as `run_to` is called.

    Attributes
    ----------
    mesh : Mesh
    half_edges : HalfEdges
        As built; its connectivity arrays are shared with `mesh` and change too.
    repairs : Repairs
    centre_m : (3,) float64
    scale_m : float
        Metres of one normalised unit.
    """

    mesh: Mesh
    half_edges: HalfEdges
    repairs: Repairs
    centre_m: Floats
    scale_m: float

    @property
    def num_faces(self) -> int:
        """Faces left."""
        return int(self.mesh.counter[rules.FACES_LEFT])

    def run_to(self, target_faces: int, max_cost: float = np.inf) -> None:
        """Collapse until that many faces are left, the next collapse costs more, or none is legal."""
        run(self.mesh, target_faces, max_cost)

    def blocked(self) -> dict[str, int]:
        """Number of edges that cannot collapse, by rule."""
        counts = np.zeros(8, np.int64)
        census(self.mesh, counts)
        return {name: int(counts[rule]) for rule, name in rules.RULE_NAMES.items() if counts[rule]}

    def snapshot(self) -> Lod:
        """What is left, as compact arrays in metres; faces in the order of the source's."""
        mesh, half_edges = self.mesh, self.half_edges
        num_faces = half_edges.num_faces
        alive = np.flatnonzero(mesh.tail[: 3 * num_faces : 3] >= 0)
        corners = (3 * alive[:, None] + np.arange(3)).ravel()
        vertices, faces = np.unique(mesh.tail[corners], return_inverse=True)
        wedges, face_uvs = np.unique(mesh.wedge[corners], return_inverse=True)
        owners = np.full(len(vertices), len(wedges), np.int64)
        np.minimum.at(owners, faces, face_uvs)
        return Lod(
            uvs=mesh.uv[wedges],
            face_uvs=face_uvs.reshape(-1, 3).astype(np.int32),
            faces=faces.reshape(-1, 3).astype(np.int32),
            owner_uvs=owners.astype(np.int32),
            face_source=half_edges.face_source[alive].astype(np.int32),
            positions=mesh.xyz[vertices] * self.scale_m + self.centre_m,
        )


def make_engine(
    surface: TexturedSurface,
    options: DecimateOptions,
    position_texture: NDArray[np.floating] | None = None,
    poses: NDArray[np.floating] | None = None,
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

    Raises
    ------
    InputError
        See `topology.build_half_edges`.
    """
    half_edges, repairs = build_half_edges(surface)
    num_faces, num_half_edges = half_edges.num_faces, len(half_edges.tail)
    num_vertices = len(half_edges.vertex_source)
    used = surface.positions[half_edges.vertex_source]
    low, high = used.min(axis=0), used.max(axis=0)
    centre, scale = 0.5 * (low + high), float(np.linalg.norm(high - low)) or 1.0
    texture = np.zeros((0, 0, 3)) if position_texture is None else (np.asarray(position_texture) - centre) / scale
    uv = np.ascontiguousarray(surface.uvs[half_edges.wedge_source], np.float64)
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

    settings = np.zeros(8)
    settings[rules.UV_SCALE] = max(options.uv_weight_rel, 1e-6) * metres_per_uv
    settings[rules.SEAM_TOLERANCE] = options.seam_tolerance_uv * max(extent_uv, 1.0)
    settings[rules.STRICT] = _STRICT[options.strict]
    settings[rules.MIN_NORMAL_DOT] = MIN_NORMAL_DOT
    settings[rules.MIN_UV_HEIGHT] = MIN_UV_HEIGHT * min(extent_uv, 1.0)
    settings[rules.MIN_SHAPE] = MIN_SHAPE
    num_poses = 0 if poses is None else len(poses)
    matrices = np.zeros((num_vertices, num_poses, 3, 4))
    if poses is not None:
        matrices[:] = np.moveaxis(np.asarray(poses, np.float64), 0, 1)[half_edges.vertex_source]

    counter = np.zeros(8, np.int64)
    counter[rules.FACES_LEFT] = num_faces
    mesh = Mesh(
        tail=half_edges.tail,
        wedge=half_edges.wedge,
        twin=half_edges.twin,
        out=half_edges.out,
        num_silhouettes=half_edges.num_silhouettes,
        xyz=xyz,
        uv=uv,
        quadric=np.zeros((len(uv), SIZE)),
        deviation=np.zeros(num_half_edges),
        blocked=np.zeros(num_half_edges, np.uint8),
        num_blocked=np.zeros(num_vertices + 1, np.int32),
        orientation=np.where(uv_area2 < 0, -1, 1).astype(np.int8),
        mark=np.zeros(num_vertices + 1, np.int32),
        counter=counter,
        texture=np.ascontiguousarray(texture, np.float64),
        pose_xyz=np.zeros((num_vertices, num_poses, 3)),
        pose_rotation=np.ascontiguousarray(matrices[..., :3]),
        pose_quadric=np.zeros((num_vertices, num_poses, POSITION_SIZE)),
        candidates=np.zeros((8, 8)),
        scratch=np.zeros((5, 6)),
        ten=np.zeros(POSITION_SIZE),
        settings=settings,
        heap=make_heap(num_half_edges),
    )
    if len(texture):
        _draw_vertices(mesh, num_vertices)
    if num_poses:
        posed = np.einsum("vpij,vj->vpi", matrices[..., :3], xyz * scale + centre) + matrices[..., 3]
        mesh.pose_xyz[:] = (posed - centre) / scale
        _accumulate_poses(mesh, num_faces)
    accumulate_faces(
        mesh.tail,
        mesh.wedge,
        num_faces,
        mesh.xyz,
        mesh.uv,
        settings[rules.UV_SCALE],
        BOUNDARY_WEIGHT,
        mesh.twin,
        mesh.quadric,
    )
    price_all(mesh)
    return Engine(mesh, half_edges, repairs, centre, scale)
