"""What decimation takes and gives: options, one level of detail, and what a run did."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from preprocess.arrays import Floats, Ints
from preprocess.mesh.surface import TexturedSurface

# Of a chain, whose levels are chosen by their largest error.
PEAK_WEIGHT = 0.4


class Strictness(Enum):
    """What a collapse must keep of the uv map.

    NONE : only the charts' topology; uvs are attributes of the quadric like any other.
    SHAPE : chart outlines stay the same curves; the two sides of a seam may be timed differently.
    SEAMLESS : outlines stay, and both sides of every seam run in step, so a seam-free texture stays seam-free.
    """

    NONE = "none"
    SHAPE = "shape"
    SEAMLESS = "seamless"


@dataclass(frozen=True)
class DecimateOptions:
    """How to decimate.

    Attributes
    ----------
    strict : Strictness
    ratios : tuple of float or None
        Faces of each level as a fraction of the input's; None halves from the full mesh down to the floor.
    min_faces : int
        The automatic chain stops here (or at the floor, whichever comes first).
    uv_weight_rel : float
        Weight of uv against xyz in the 5D quadric. 1 measures a texture slid over the surface by a metre like a
        surface moved by a metre; far less keeps the silhouette, which is what the eye sees first.
    seam_tolerance_uv : float or None
        Seams that are straight and matched to within this uv distance are made so before anything else. None takes
        what the uvs' own precision leaves open (seam_precision.py), far below what any texture resolves.
    peak_weight : float or None
        How much the largest deviation of a collapse counts beside its mean, which the quadrics know: at 1 a collapse
        costs what it would if all of an average star of faces deviated as much. 0 leaves it to the quadrics, which is
        three times as fast. None is 0 where the target is a number of faces, `PEAK_WEIGHT` where levels have an error.
    lifted : bool
        Whether vertices of polished levels may leave the surface, which lies inside of it wherever it bulges.
    relaxed_px : float
        Largest such distance at levels near and below the exact floor, in texels of the mip level they are seen at; 0
        for none.
    drop_parts : bool
        Whether relaxed levels may leave out whole parts that are smaller than their error, a pixel where they are
        used; each says how many.
    texture_px : int
        Side of the largest texture, which says what the finest mip is.
    """

    strict: Strictness = Strictness.SEAMLESS
    ratios: tuple[float, ...] | None = None
    min_faces: int = 50
    uv_weight_rel: float = 0.05
    seam_tolerance_uv: float | None = None
    peak_weight: float | None = None
    lifted: bool = True
    relaxed_px: float = 0.5
    drop_parts: bool = True
    texture_px: int = 1024


@dataclass(frozen=True)
class Lod:
    """One level of detail. T texture vertices, V surface vertices, F faces, all compact.

    Attributes
    ----------
    uvs : (T, 2) float64
    face_uvs : (F, 3) int32, into uvs
    faces : (F, 3) int32, surface vertices: what is welded
    canonical_uvs : (V,) int32
        The texture vertex at whose uv every copy of a surface vertex fetches its geometry.
    face_source : (F,) int32
        A face of the full mesh that each face stems from, for its material and part.
    positions : (V, 3) float64
        Where the surface vertices are drawn in bind pose, metres.
    error_m, mean_error_m : float
        Largest and mean two-sided distance to the full mesh over surface samples and poses; NaN where not measured.
        No less than a finer level's, and at relaxed levels no less than what hides their seams: a bound to select by.
    normal_error_rad : float
        Mean angle between the normals there; NaN where not measured.
    exact : bool
        Whether every seam of it is a seam of the full mesh, retimed by nothing but rounding.
    uv_bound_px : float
        How far seams left their lines, in texels of the finest mip; 0 (rounding aside) where exact.
    dropped_parts : int
        Whole parts of the mesh left out because they are smaller than the level's error.
    fetch_uvs : (V, 2) float64 or None
        Where each surface vertex fetches its geometry, if not at its canonical uv.
    """

    uvs: Floats
    face_uvs: Ints
    faces: Ints
    canonical_uvs: Ints
    face_source: Ints
    positions: Floats
    error_m: float = float("nan")
    mean_error_m: float = float("nan")
    normal_error_rad: float = float("nan")
    exact: bool = True
    uv_bound_px: float = 0.0
    dropped_parts: int = 0
    fetch_uvs: Floats | None = None

    @property
    def num_faces(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    @property
    def surface(self) -> TexturedSurface:
        """The level as a mesh of its own."""
        return TexturedSurface(self.positions, self.faces, self.uvs, self.face_uvs)


@dataclass(frozen=True)
class Repairs:
    """What had to be changed before edges could collapse; all zero for a clean mesh."""

    degenerate_faces: int = 0
    duplicate_faces: int = 0
    isolated_vertices: int = 0
    split_edges: int = 0
    split_vertices: int = 0

    def warnings(self) -> tuple[str, ...]:
        """One line for each kind of repair that was made."""
        lines = []
        if self.degenerate_faces:
            lines.append(f"{self.degenerate_faces} faces that use a vertex twice were dropped")
        if self.duplicate_faces:
            lines.append(f"{self.duplicate_faces} duplicate faces were dropped")
        if self.isolated_vertices:
            lines.append(f"{self.isolated_vertices} vertices that no face uses were dropped")
        if self.split_edges:
            lines.append(f"{self.split_edges} non-manifold edges were cut open")
        if self.split_vertices:
            lines.append(f"{self.split_vertices} non-manifold vertices were split")
        return tuple(lines)


@dataclass(frozen=True)
class Chain:
    """The levels of one run, finest first, and what it met.

    Attributes
    ----------
    lods : tuple of Lod
    floor_faces : int
        Where no legal collapse was left at exact seams; -1 where the run stopped before.
    blocked : dict from rule to number of edges
        Why the edges that are left at the end cannot collapse (empty where the run stopped before).
    repairs : Repairs
    """

    lods: tuple[Lod, ...]
    floor_faces: int
    blocked: dict[str, int]
    repairs: Repairs

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line for each kind of repair, and for each level whose seams are relaxed."""
        lines = list(self.repairs.warnings())
        for number, lod in enumerate(self.lods):
            if not lod.exact:
                line = f"level {number} ({lod.num_faces} faces) has seams relaxed by up to {lod.uv_bound_px:.1f} texels"
                lines.append(line + (f" and leaves out {lod.dropped_parts} small parts" if lod.dropped_parts else ""))
        return tuple(lines)
