"""The arrays that flow through the pipeline. Stages return new ones and never change their input.

Letters in shapes: V surface vertices, T texture vertices, F faces, J joints, K influences per vertex, L texcoord sets.
A surface vertex is a welded 3D point; a texture vertex is one of its uv images. Where a surface vertex has two or
more texture vertices a seam runs through it (paper, section 5.2: the pair is the paper's Z vertex).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats, Ints
from preprocess.mesh.morphs import Morph


@dataclass(frozen=True)
class TexturedSurface:
    """A surface mesh and its parameter mesh, corner by corner.

    Attributes
    ----------
    positions : (V, 3) float64, metres
    faces : (F, 3) int32, into positions, counter-clockwise seen from outside
    uvs : (T, 2) float64, glTF's convention (origin top left, v down)
    face_uvs : (F, 3) int32, into uvs
    """

    positions: Floats
    faces: Ints
    uvs: Floats
    face_uvs: Ints

    def validate(self) -> None:
        """Assert our own invariants: shapes, dtypes, index ranges, finite numbers."""
        num_faces = len(self.faces)
        assert self.positions.ndim == 2 and self.positions.shape[1] == 3
        assert self.uvs.ndim == 2 and self.uvs.shape[1] == 2
        assert self.faces.shape == self.face_uvs.shape == (num_faces, 3)
        assert self.faces.dtype == self.face_uvs.dtype == np.int32
        assert np.isfinite(self.positions).all() and np.isfinite(self.uvs).all()
        if num_faces:
            assert 0 <= self.faces.min() and self.faces.max() < len(self.positions)
            assert 0 <= self.face_uvs.min() and self.face_uvs.max() < len(self.uvs)

    @property
    def diagonal_m(self) -> float:
        """Length of the bounding box's diagonal, metres."""
        if not len(self.positions):
            return 0.0
        return float(np.linalg.norm(np.ptp(self.positions, axis=0)))


@dataclass(frozen=True)
class SkinnedMesh:
    """One character: every part of the file as one welded mesh in bind pose, with one list of joints.

    Attributes
    ----------
    surface : TexturedSurface
        In object space at bind pose. After loading, its uvs are the source's TEXCOORD_0 welded (one uv at 0, 0
        for all corners where the file has none: see `has_uvs`); after the atlas stage, the atlas.
    corner_normals : (F, 3, 3) float64
        Unit normals per corner, object space, from the file (or computed where it has none).
    corner_tangents : (F, 3, 4) float64 or None
        glTF tangents (xyz, handedness) where the file has them, NaN where it has none.
    corner_texcoords : (F, 3, L, 2) float64
        The source's own texture coordinates per corner, one per TEXCOORD set (L may be 0). They stay when the atlas
        changes: colours are resampled through them.
    corner_colors : (F, 3, 4) float32 or None
        Linear vertex colours (COLOR_0), white where a part has none.
    joint_indices : (V, K) int32
        Into the character's joint list. Unused slots hold joint 0 with weight 0.
    joint_weights : (V, K) float64
        Non-negative, each row sums to one.
    face_materials : (F,) int32
        Into the character's material list.
    face_parts : (F,) int32
        Which primitive of the file a face came from.
    has_uvs : bool
        Whether every face came with texture coordinates.
    morphs : tuple of Morph
        Blend shapes, relative to `surface`.
    face_num_texcoords : (F,) int32 or None
        How many of the L sets each face came with; its others are zeros and mean nothing. None: all.
    """

    surface: TexturedSurface
    corner_normals: Floats
    corner_tangents: Floats | None
    corner_texcoords: Floats
    corner_colors: NDArray[np.float32] | None
    joint_indices: Ints
    joint_weights: Floats
    face_materials: Ints
    face_parts: Ints
    has_uvs: bool
    morphs: tuple[Morph, ...] = ()
    face_num_texcoords: Ints | None = None

    @property
    def num_faces(self) -> int:
        """Number of triangles."""
        return len(self.surface.faces)

    @property
    def num_vertices(self) -> int:
        """Number of welded surface vertices."""
        return len(self.surface.positions)

    def has_texcoords(self, texcoord_set: int) -> NDArray[np.bool_]:
        """Which faces came with a texture coordinate set, (F,) bool."""
        if texcoord_set >= self.corner_texcoords.shape[2]:
            return np.zeros(self.num_faces, bool)
        if self.face_num_texcoords is None:
            return np.ones(self.num_faces, bool)
        return self.face_num_texcoords > texcoord_set

    def with_surface(self, surface: TexturedSurface) -> SkinnedMesh:
        """The same character with another surface of the same faces (new uvs, say)."""
        assert len(surface.faces) == self.num_faces
        return dataclasses.replace(self, surface=surface, has_uvs=True)

    @property
    def num_moving_joints(self) -> int:
        """Joints up to the last that moves something; the others come after them."""
        return int(self.joint_indices[self.joint_weights > 0].max(initial=0)) + 1

    def dense_weights(self, num_joints: int) -> Floats:
        """Weights as a matrix, (V, J) float64, rows summing to one."""
        dense = np.zeros((self.num_vertices, num_joints))
        rows = np.repeat(np.arange(self.num_vertices), self.joint_indices.shape[1])
        np.add.at(dense, (rows, self.joint_indices.ravel()), self.joint_weights.ravel())
        return dense

    def validate(self) -> None:
        """Assert our own invariants."""
        self.surface.validate()
        num_faces, num_vertices = self.num_faces, self.num_vertices
        assert self.corner_normals.shape == (num_faces, 3, 3)
        assert self.corner_tangents is None or self.corner_tangents.shape == (num_faces, 3, 4)
        assert self.corner_texcoords.shape[:2] == (num_faces, 3) and self.corner_texcoords.shape[3] == 2
        assert self.corner_colors is None or self.corner_colors.shape == (num_faces, 3, 4)
        assert self.joint_indices.shape == self.joint_weights.shape
        assert len(self.joint_indices) == num_vertices
        assert (self.joint_weights >= 0).all()
        assert np.allclose(self.joint_weights.sum(axis=1), 1.0, atol=1e-6)
        for morph in self.morphs:
            assert morph.shifts.shape == (len(morph.vertices), 3) and morph.turns.shape == (len(morph.vertices), 3, 3)
            assert np.isfinite(morph.shifts).all() and np.isfinite(morph.turns).all()
            assert not len(morph.vertices) or 0 <= morph.vertices.min() <= morph.vertices.max() < num_vertices
        assert self.face_materials.shape == self.face_parts.shape == (num_faces,)
