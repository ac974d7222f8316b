"""The texture stage: bake every signal into the atlas, erase its seams, round it so that what is stored is seamless.

One eraser (grid, energies, factorisation) serves all textures of a size; one coverage serves all bakes of a size.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.arrays import Floats
from preprocess.atlas import Atlas
from preprocess.atlas.chart_scales import NORMAL_SIZE_PX
from preprocess.bake.color_borders import BORDER, find_color_borders
from preprocess.bake.hard_edges import NormalUvs, bake_surface, erase_surface, find_normal_uvs, move_seams
from preprocess.bake.materials import BakedTexture, bake_materials, bake_normals, normal_tangents, normals_at
from preprocess.bake.seam_points import points_near_seams
from preprocess.decimate import Lod
from preprocess.erase import (
    GLOBAL,
    LOCAL,
    EraseOptions,
    Level,
    erase_mips,
)
from preprocess.erase.local.mips import Bands, close_mips
from preprocess.erase.mips import is_crowded, mip_sizes
from preprocess.erase.seam_classification import Decision, choose_color_seams, choose_normal_seams, draw_decision
from preprocess.fit.level_normal_uvs import find_level_normal_uvs
from preprocess.fit.stored_texture import StoredTexture, jump
from preprocess.load import Character
from preprocess.mesh.raster import Coverage, cover_atlas
from preprocess.mesh.seams import Seams, find_seams, pack_seams, pick_seams
from preprocess.mesh.surface import SkinnedMesh, TexturedSurface
from preprocess.settings import Settings

log = logging.getLogger(__name__)

PICTURE_PX = 768  # side of the pictures for the report
STEPS = {"uint8": 255, "uint16": 65535}
# Normals are made unit when shaded. Stored a little shorter they leave their solution room along the axes: held within
# its range, it would jump.
NORMAL_LENGTH = 0.8
# Normals give way within a texel or two of a seam: what is smooth there is measured in degrees, and spread further it
# would tilt whole strips. RMS of all points of human against the source, degrees, by this weight: 1.15 with 20, 1.03
# with 100, 0.985 with 500, 0.975 with 3000.
NORMAL_CHANGE = 500.0
# Normal maps are held to the source at points beside seams, a texel's worth of them this much more than the texel
# itself. RMS as above: human 1.41 without, 1.18 with limited jumps alone, 0.93 with both.
SAMPLE_WEIGHT = 10.0
MOST_STORED = 0.51  # 255ths that seams may jump by as stored, before a note says that they do
POINT_FINENESS = 4  # points are averages of the map over as small a part of a texel
# A mip chain ends where closing the seams would move what is inside charts by more than this, root mean square. On a
# crowd of human seen from afar (FLIP against full detail): 0.041 with all levels, 0.033 to 32 x 32, 0.030 to 64 x 64.
# Normals may turn by about ten degrees: an average of them is what a far-away surface looks like.
MOST_MIP_CHANGE = {"color": 5 / 255, "other": 20 / 255}
# By stored format: weight of the mean squared jump, and the jump up to which it costs nothing (see EraseOptions). What
# is seen is closed to under half an 8-bit step, rounding included; colours keep the detail that fits in. At its seams
# the built-in character is 4.6 steps from the mean of both sides, root mean square; 6.2 where every jump costs (1e10).
SEAM_WEIGHT = {"uint8": 3e9, "uint16": 1e10}
JUMP_LIMIT = {"uint8": 0.2 / 255, "uint16": 0.2 / 255}


def _encode_normals(normals: Floats) -> Floats:
    """Unit vectors as they are stored, in [0, 1]."""
    return 0.5 * NORMAL_LENGTH * normals + 0.5


@dataclass(frozen=True)
class _Job:
    """A baked texture that awaits erasure: name, texels, format, channels in sRGB, joined seams, manifest keys.

    `erased_on` is where it is erased, if not on the atlas like the others, all of its seams joined; `samples` are uvs
    and values there that it should have.
    """

    name: str
    baked: Floats
    format: str
    srgb_channels: int
    decision: Decision
    extra: dict[str, Any] = field(default_factory=dict)
    erased_on: tuple[TexturedSurface, Seams] | None = None
    samples: tuple[Floats, Floats] | None = None

    @property
    def key(self) -> bytes:
        """Equal for textures that share their erasers: normals have their own, all colours one if alike in seams."""
        return self.format.encode() + self.decision.joined.tobytes()


class TextureStage:
    """Everything that bakes and erasures of one character share."""

    def __init__(self, character: Character, atlas: Atlas, poses: Floats, settings: Settings) -> None:
        """Find the seams.

        Parameters
        ----------
        character : Character
        atlas : Atlas
        poses : (P, J, 4, 4) float64
            Skinning matrices of a few poses of the clips.
        settings : Settings
        """
        self.character = character
        self.atlas = atlas
        self.mesh: SkinnedMesh = atlas.mesh
        self.poses = poses
        self.settings = settings
        self.seams: Seams = find_seams(self.mesh.surface)
        self.made_here = self._find_made_seams()
        self.decisions: dict[str, Decision] = {}
        self.notes: list[str] = []
        self.normal_size = self.settings.color_size_px or atlas.sides.get("normal", NORMAL_SIZE_PX)
        size = (self.normal_size, self.normal_size)
        unwrapped = atlas.kept_share < 1.0
        self.borders = find_color_borders(character, self.mesh, size) if unwrapped else None
        half_edges = None if self.borders is None else self.borders.half_edges()
        self.normal_uvs: NormalUvs | None = find_normal_uvs(self.mesh, size, half_edges)
        self.colors_moved = unwrapped and self.normal_uvs is not None
        self._coverage: dict[tuple[int, int], Coverage] = {}
        self._moved_coverage: dict[tuple[int, int], Coverage] = {}

    def cover(self, width: int, height: int) -> Coverage:
        """The atlas rasterised at a size, once."""
        size = (width, height)
        if size not in self._coverage:
            self._coverage[size] = cover_atlas(self.mesh, width, height)
        return self._coverage[size]

    def cover_moved(self, width: int, height: int) -> Coverage:
        """The normal uvs rasterised at a size, once."""
        assert self.normal_uvs is not None
        if (width, height) not in self._moved_coverage:
            moved = self.mesh.with_surface(bake_surface(self.mesh.surface, self.normal_uvs))
            self._moved_coverage[width, height] = cover_atlas(moved, width, height)
        return self._moved_coverage[width, height]

    def options(self, joined: NDArray[np.bool_] | None, stored: str) -> EraseOptions:
        """How seams are erased here, of a texture of a stored format."""
        weights = GLOBAL if self.settings.seams == "global" else LOCAL
        return EraseOptions(
            weights=weights, joined=joined, seam_weight=SEAM_WEIGHT[stored], jump_limit=JUMP_LIMIT[stored]
        )

    def normal(self) -> StoredTexture:
        """The normal texture alone."""
        return self._store(self._normal())

    def build(self) -> list[StoredTexture]:
        """Every texture but geometry, on two threads; those with the same joined seams share bands and a thread."""
        pool = ThreadPoolExecutor(2)
        try:
            groups: dict[bytes, list[_Job]] = {}
            jobs = [self._normal(), *self._materials()]
            for job in jobs:
                groups.setdefault(job.key, []).append(job)
            longest_first = sorted(groups.values(), key=len, reverse=True)
            running = [pool.submit(self._store_all, group) for group in longest_first]
            seen = {texture.name: texture for group in running for texture in group.result()}
            self.notes.sort()  # whichever thread was first
            return [seen[job.name] for job in jobs]
        finally:
            pool.shutdown(wait=False, cancel_futures=True)  # an interrupt does not wait for a long factorisation

    def level_normal_uvs(self, lods: Sequence[Lod]) -> list[Floats | None]:
        """Where each level's corners sample the normal texture, (F, 3, 2); None where that is at their own uvs."""
        if self.normal_uvs is None:
            return [None] * len(lods)
        size = (self.normal_size, self.normal_size)
        return [find_level_normal_uvs(self.mesh.surface, self.normal_uvs, lod, size) for lod in lods]

    def _normal(self) -> _Job:
        """Object-space normals with the source's normal maps in them, 16 bits; hard edges stay."""
        size, uvs, mesh = (self.normal_size, self.normal_size), self.normal_uvs, self.mesh
        tangents = normal_tangents(self.character, mesh)
        decision = choose_normal_seams(mesh.surface, self.seams, mesh.corner_normals)
        moved = mesh if uvs is None else mesh.with_surface(bake_surface(mesh.surface, uvs))
        coverage = self.cover(*size) if uvs is None else self.cover_moved(*size)
        baked = bake_normals(self.character, moved, tangents, coverage)
        erased_on = self._erased_on(decision, uvs)
        is_global = self.settings.seams == "global"
        samples = None if tangents is None or not is_global else self._normal_samples(moved, tangents, *erased_on)
        return self._decided(
            _Job("normal", _encode_normals(baked), "uint16", 0, decision, erased_on=erased_on, samples=samples)
        )

    def _normal_samples(
        self, moved: SkinnedMesh, tangents: Floats, surface: TexturedSurface, seams: Seams
    ) -> tuple[Floats, Floats]:
        """Points beside seams and the normals that the source has there: maps have detail that seams would cost."""
        corner_uvs = moved.surface.uvs[moved.surface.face_uvs]
        size = (self.normal_size, self.normal_size)
        points = points_near_seams(moved.surface, corner_uvs, surface.uvs[seams.uv_pairs], size)
        finer = (POINT_FINENESS * size[0], POINT_FINENESS * size[1])
        normals = normals_at(self.character, moved, tangents, points.faces, points.barycentrics, finer)
        return points.interpolate(corner_uvs), _encode_normals(normals)

    def _erased_on(self, decision: Decision, uvs: NormalUvs | None) -> tuple[TexturedSurface, Seams]:
        """Where a texture is erased whose seams that are left are not to be touched."""
        surface, seams = self.mesh.surface, pick_seams(self.seams, decision.joined)
        if uvs is None:
            return surface, seams
        return erase_surface(surface, uvs), move_seams(seams, surface, uvs)

    def _materials(self) -> list[_Job]:
        """Base colour and, where the character has them, occlusion-roughness-metallic and emissive."""
        mesh, cover = self.mesh, self.cover
        if self.colors_moved:
            assert self.normal_uvs is not None
            mesh, cover = mesh.with_surface(bake_surface(mesh.surface, self.normal_uvs)), self.cover_moved
        side = self.settings.color_size_px
        baked = bake_materials(self.character, mesh, self.atlas.resampled, side, cover, self.atlas.sides)
        return [self._material(texture) for texture in baked]

    def _material(self, texture: BakedTexture) -> _Job:
        threshold = np.inf if self.settings.keep_borders is None else self.settings.keep_borders
        decision = choose_color_seams(
            texture.texels, self.mesh.surface, self.seams, threshold, made_here=self.made_here
        )
        erased_on = None
        if self.borders is not None:
            gaps = self.borders.along_seams(self.seams, self.mesh.surface.faces)
            limit = np.inf if self.settings.keep_borders is None else min(threshold, BORDER)
            decision = Decision(gaps <= limit, gaps, limit)
            erased_on = self._erased_on(decision, self.normal_uvs if self.colors_moved else None)
        # What is copied lacks the material's factors: the model keeps them (model_materials.py).
        extra: dict[str, Any] = {"copied": texture.copied}
        if texture.scale != 1.0:
            extra["scale"] = texture.scale
        if self.colors_moved:
            extra["uvs"] = "normal"
        job = _Job(texture.name, texture.texels, texture.format, 3 if texture.is_color else 0, decision, extra)
        return self._decided(dataclasses.replace(job, erased_on=erased_on))

    def _decided(self, job: _Job) -> _Job:
        self.decisions[job.name] = job.decision
        return job

    def draw_decisions(self) -> dict[str, Floats]:
        """Pictures, by caption, of which seams were joined and which were taken for creases or painted borders."""
        size = (PICTURE_PX, PICTURE_PX, 3)
        pictures = {}
        for name, decision in self.decisions.items():
            caption = f"{name}: {decision.num_left} of {len(decision.joined)} seam edges left (red)"
            pictures[caption] = draw_decision(np.full(size, 0.5), self.mesh.surface, self.seams, decision)
        return pictures

    def _find_made_seams(self) -> NDArray[np.bool_]:
        """Seams inside one material that the atlas made and the source did not have, (S,) bool."""
        faces = self.seams.faces[:, 0]
        corner = (self.mesh.surface.faces[faces] == self.seams.vertices[:, :1]).argmax(axis=1)
        after = self.mesh.surface.faces[faces, (corner + 1) % 3] == self.seams.vertices[:, 1]
        half_edge = np.where(after, corner, (corner + 2) % 3)  # of corner c to c + 1
        materials = self.mesh.face_materials[self.seams.faces]
        result: NDArray[np.bool_] = self.atlas.made_seams[faces, half_edge] & (materials[:, 0] == materials[:, 1])
        return result

    def _store_all(self, jobs: list[_Job]) -> list[StoredTexture]:
        """Store textures that share the bands beside their seams."""
        bands: Bands = {}
        return [self._store(job, bands) for job in jobs]

    def _note(self, name: str, levels: Sequence[Level], size: tuple[int, int]) -> None:
        """What could not be done."""
        worst = 255 * max(level.stored.max.max(initial=0.0) for level in levels)
        if worst > MOST_STORED:
            self.notes.append(f"{name}: its seams could not be closed: they jump by up to {worst:.1f} of 255")
        sizes = mip_sizes(*size)
        if len(levels) < len(sizes) and is_crowded(self.mesh.surface, self.seams, *sizes[len(levels)]):
            last = sizes[len(levels) - 1]
            self.notes.append(
                f"{name}: mip levels end at {last[0]} x {last[1]}: below, charts are narrower than texels"
            )

    def _store(self, job: _Job, bands: Bands | None = None) -> StoredTexture:
        """Erase a texture and its mip levels, rounded so that what is stored is seamless."""
        steps, left = STEPS[job.format], job.decision.num_left
        surface, seams = job.erased_on or (self.mesh.surface, self.seams)
        options = self.options(job.decision.joined if left else None, job.format)
        if job.erased_on:
            weights = dataclasses.replace(options.weights, change=NORMAL_CHANGE * options.weights.change)
            if job.samples is not None:
                weights = dataclasses.replace(weights, samples=SAMPLE_WEIGHT * len(job.samples[0]))
            options = dataclasses.replace(options, joined=None, weights=weights)
        how: dict[str, Any] = {
            "levels": steps,
            "srgb_channels": job.srgb_channels,
            "most_change": MOST_MIP_CHANGE["color" if job.srgb_channels else "other"],
        }
        if self.settings.seams == "global":
            levels = erase_mips(job.baked, surface, seams, options, samples=job.samples, **how)
        else:
            levels = close_mips(
                job.baked, surface, seams, options, bands=bands, even_reach=job.erased_on is not None, **how
            )
        seam: dict[str, Any] = {
            "before": jump(levels[0].before),
            "after": jump(levels[0].after),
            "stored": [jump(level.stored) for level in levels],
        }
        if left:
            seam["left"] = left
            seam["left_seams"] = pack_seams(self.mesh.surface, self.seams, ~job.decision.joined)
        texels = tuple(level.texels / float(steps) for level in levels)
        height, width = job.baked.shape[:2]
        self._note(job.name, levels, (width, height))
        return StoredTexture(job.name, texels, job.format, (width, height), seam, job.extra)
