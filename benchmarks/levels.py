"""Faces that a level needs for a largest error: the pipeline's own chain, and meshoptimizer's `simplify`.

Both of the character's own atlas, measured alike: largest distance both ways over the pipeline's samples and poses, in
per cent of the longest extent. The chain keeps seams to half a texel of the mip level that a level is seen at.
meshoptimizer, where it is installed, gets the welded mesh without attributes, three levels an octave. "-" where no
level with fewer faces than the full mesh is near enough.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._inputs import command_line, source_files
from benchmarks._table import print_table
from preprocess.arrays import Floats, Ints
from preprocess.atlas import character_atlas
from preprocess.bake.geometry import bake_surface_positions
from preprocess.decimate import decimate
from preprocess.decimate.measure import Reference, make_reference, sample_mesh
from preprocess.load import load_character
from preprocess.load.pose_sampling import sample_poses
from preprocess.mesh.closest_point import build_tree
from preprocess.mesh.surface import TexturedSurface
from preprocess.pipeline import SURFACE_PX, draw_groups
from preprocess.settings import Settings

MODELS = (
    *("human.glb", "mannequiny.glb", "Knight.glb", "Fox.glb", "robot.glb", "lumberjack.glb", "cat.glb"),
    *("phoenix_bird.glb", "BrainStem.glb"),
)
ERRORS_REL = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.05, 0.07, 0.1)
STEPS_PER_OCTAVE, COARSEST_FACES = 3, 60

Ladder = list[tuple[int, float]]  # faces and largest error, metres, of each level


def _meshoptimizer(surface: TexturedSurface, reference: Reference) -> Ladder | None:
    """Its levels, measured as ours are; None where it is not installed."""
    try:
        import meshoptimizer
    except ImportError:
        return None
    positions = np.ascontiguousarray(surface.positions, np.float32)
    indices = np.ascontiguousarray(surface.faces.ravel(), np.uint32)
    levels: Ladder = []
    wanted = float(len(surface.faces))
    while wanted >= COARSEST_FACES:
        result = np.zeros_like(indices)
        options: dict[str, Any] = {"target_index_count": 3 * int(wanted), "target_error": 1e9}
        count = meshoptimizer.simplify(
            result, indices, positions, len(indices), len(positions), positions.strides[0], **options
        )
        faces = result[:count].reshape(-1, 3).astype(np.int32)
        levels.append((len(faces), _largest_m(reference, surface.positions, faces)))
        wanted /= 2 ** (1 / STEPS_PER_OCTAVE)
    return levels


def _largest_m(reference: Reference, positions: Floats, faces: Ints) -> float:
    """Largest two-sided distance of faces over the full mesh's own vertices, in all poses, metres."""
    samples, largest = sample_mesh(positions, faces, reference.num_samples), 0.0
    for posed, tree in zip(reference.posed, reference.trees, strict=True):
        there = tree.query(samples.points(posed, faces))[0].max()
        full = reference.samples.points(posed, reference.surface.faces)
        largest = max(largest, float(there), float(build_tree(posed[faces]).query(full)[0].max()))
    return largest


def _fewest(ladder: Ladder | None, error_m: float, num_faces: int) -> int | None:
    good = [faces for faces, error in ladder or () if error <= error_m and faces < num_faces]
    return min(good, default=None)


def _measure(model: Path) -> list[dict[str, Any]]:
    """One row an error."""
    character, settings = load_character(model), Settings()
    mesh, poses = character_atlas(character, settings).mesh, sample_poses(character)
    surface = mesh.surface
    blended = np.einsum("vj,pjik->pvik", mesh.dense_weights(poses.shape[1]), poses[:, :, :3])
    position, groups = (
        bake_surface_positions(mesh, (SURFACE_PX, SURFACE_PX)),
        draw_groups(character, mesh.face_materials),
    )
    chain = decimate(surface, position_texture=position, poses=blended, face_groups=groups)
    ours: Ladder = [(lod.num_faces, lod.error_m) for lod in chain.lods]
    extent_m = float(np.ptp(surface.positions, axis=0).max())
    rival = _meshoptimizer(surface, make_reference(surface, blended))
    ladders = {"seamskin": ours, "meshoptimizer": rival}
    return [
        {"character": model.stem, "largest error %": 100 * error_rel}
        | {name: _fewest(ladder, error_rel * extent_m, len(surface.faces)) for name, ladder in ladders.items()}
        for error_rel in ERRORS_REL
    ]


def run(argv: list[str]) -> list[dict[str, Any]]:
    """Print the table; see the module's text."""
    parser = command_line("levels", __doc__)
    parser.add_argument("--models", type=Path, nargs="+", help="instead of the test characters")
    models = source_files(parser.parse_args(argv).models, MODELS, "--models FILE")
    rows = [row for model in models for row in _measure(model)]
    print_table(rows)
    return rows
