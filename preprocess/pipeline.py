"""The stages in order: load, atlas, textures (bake, erase, store), levels of detail, write, verify.

What was written is read again by the runtime's own loader and measured beside the source (preprocess/verify). Where it
is beyond the goals another way is tried; the best of all tries is kept, and what is still beyond is in its warnings.
"""

from __future__ import annotations

import dataclasses
import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from preprocess.arrays import Floats, Ints
from preprocess.atlas import Atlas, character_atlas
from preprocess.bake.geometry import bake_surface_positions
from preprocess.decimate import Chain, DecimateOptions, decimate
from preprocess.decimate.chain import near_enough
from preprocess.export.folder import LodRow, write_folder, write_manifest
from preprocess.export.report import write_report
from preprocess.files.output_folder import atomic_folder
from preprocess.fit.level_geometry import fit_levels
from preprocess.fit.stored_texture import StoredTexture
from preprocess.fit.textures import TextureStage
from preprocess.fit.uv_quantisation import snap_levels, snap_mesh
from preprocess.load import Character, load_character
from preprocess.load.pose_sampling import sample_poses
from preprocess.mesh.morphs import choose_shapes, shaped_matrices, shift_vertices
from preprocess.mesh.surface import TexturedSurface
from preprocess.progress import Progress
from preprocess.settings import Settings
from preprocess.verify.goals import Finding, as_json, judge
from preprocess.verify.measure import Measurement, measure
from preprocess.verify.retries import next_retry
from runtime.asset.asset import load

log = logging.getLogger(__name__)

SURFACE_PX = 1024  # side of the texture that stands for the surface when levels are costed


@dataclass(frozen=True)
class BuildResult:
    """What a build made.

    Attributes
    ----------
    lods : tuple of LodRow
    warnings : tuple of str
        Everything that was changed, dropped or approximated.
    timings : dict of str to float
        Seconds a stage.
    """

    lods: tuple[LodRow, ...]
    warnings: tuple[str, ...]
    timings: dict[str, float]


def build(model: Path, destination: Path, settings: Settings, progress: Progress) -> BuildResult:
    """Build a character's folder from its file.

    Parameters
    ----------
    model : Path
        .gltf, .glb or .vrm.
    destination : Path
        Replaced as a whole when everything has succeeded.
    settings : Settings
    progress : Progress

    Raises
    ------
    InputError
        If the file cannot be used; nothing is written then.
    """
    with atomic_folder(destination) as folder:
        with progress.stage("load") as stage:
            character = load_character(model, settings.limits)
            mesh = character.mesh
            stage.delta = (
                f"{mesh.num_faces} faces, {character.skeleton.num_joints} joints, {len(character.clips)} clips"
            )
        tries: list[_Try] = []
        trying: Settings | None = settings
        draft: _Draft | None = None
        ways: list[str] = []
        while trying is not None:
            draft = _make_draft(character, trying, progress, draft)
            tried = _build_once(character, draft, folder / f"try-{len(tries)}", trying, progress)
            tries.append(tried)
            with progress.stage("verify") as stage:
                found = measure_folder(tried.folder, character)
                tried.findings, tried.manifest["measurements"] = judge(found), as_json(found)
                following = next_retry(trying, tried.manifest, tried.findings, ways)
                faults = sum(not finding.holds for finding in tried.findings)
                stage.delta = f"{faults} figures beyond their goals" if faults else "all figures within their goals"
                if following is not None:
                    stage.delta += f": again, with {following[0]}"
            trying = None
            if following is not None:
                ways.append(following[0])
                trying = following[1]
        return _keep(min(tries, key=lambda one: one.badness), folder, ways, progress)


def measure_folder(folder: Path, character: Character) -> Measurement:
    """Measure what was written, as the runtime reads it."""
    return measure(load(folder), character)


@dataclass
class _Try:
    """One built folder, its manifest, pictures for the report, and what was found when it was measured."""

    folder: Path
    manifest: dict[str, Any]
    surface: TexturedSurface
    pictures: dict[str, Floats]
    findings: list[Finding] = field(default_factory=list)

    @property
    def badness(self) -> tuple[int, int, float]:
        """What the best of several has least of."""
        gross = sum(finding.is_gross for finding in self.findings)
        return (
            gross,
            sum(not finding.holds for finding in self.findings),
            self.manifest["measurements"]["vertices"]["rms"],
        )


def _keep(chosen: _Try, folder: Path, ways: Sequence[str], progress: Progress) -> BuildResult:
    """Move the best try up into the folder, its manifest told what was found; throw the others away."""
    manifest = chosen.manifest
    manifest["warnings"] += [finding.text for finding in chosen.findings if not finding.holds]
    manifest["measurements"]["tried_again_with"] = list(ways)
    manifest["timings"] = {name: round(seconds, 3) for name, seconds in progress.seconds.items()}
    write_manifest(chosen.folder, manifest)
    if manifest["settings"]["report"]:
        write_report(chosen.folder / "report.html", manifest, chosen.surface, chosen.pictures)
    for path in chosen.folder.iterdir():
        path.rename(folder / path.name)
    for path in folder.glob("try-*"):
        shutil.rmtree(path)
    rows = tuple(LodRow(**row) for row in manifest["lods"])
    return BuildResult(rows, tuple(manifest["warnings"]), dict(progress.seconds))


@dataclass(frozen=True)
class _Draft:
    """What does not depend on the sizes of geometry's maps: a try with other sizes goes on from here."""

    settings: Settings
    poses: Floats
    stored: Atlas
    baking: TextureStage
    textures: list[StoredTexture]
    chain: Chain

    def serves(self, settings: Settings) -> bool:
        """Whether other settings would draft the same."""
        sizes: dict[str, Any] = {"geometry_size_px": None, "weight_size_px": None}
        return dataclasses.replace(settings, **sizes) == dataclasses.replace(self.settings, **sizes)


def _make_draft(character: Character, settings: Settings, progress: Progress, before: _Draft | None) -> _Draft:
    """Atlas, colours, normals and levels; those of the try before, where these settings change none of them."""
    if before is not None and before.serves(settings):
        return before
    with progress.stage("atlas") as stage:
        atlas = character_atlas(character, settings)
        stored = dataclasses.replace(atlas, mesh=snap_mesh(atlas.mesh))
        stage.delta = f"{atlas.mode}, {atlas.num_charts} charts, floor {atlas.floor_faces} faces"
    poses = sample_poses(character)
    with progress.stage("textures") as stage:
        baking = TextureStage(character, stored, poses, settings)
        textures = baking.build()
        stage.delta = ", ".join(f"{t.name} {t.size[0]}×{t.size[1]}" for t in textures)
    with progress.stage("levels") as stage:
        chain = _build_lods(character, atlas, textures, poses, settings)
        if stored.mesh is not atlas.mesh:
            chain = dataclasses.replace(chain, lods=snap_levels(chain.lods))
        stage.delta = " → ".join(str(lod.num_faces) for lod in chain.lods)
    return _Draft(settings, poses, stored, baking, textures, chain)


def _build_once(character: Character, draft: _Draft, folder: Path, settings: Settings, progress: Progress) -> _Try:
    """From the levels on, into a folder of their own."""
    folder.mkdir()
    stored, baking, chain = draft.stored, draft.baking, draft.chain
    with progress.stage("fit") as stage:
        shapes = choose_shapes(stored.mesh.morphs, stored.mesh.num_vertices)
        sizes = (settings.geometry_size_px, settings.weight_size_px)
        geometry, lods = fit_levels(stored.mesh, chain.lods, draft.poses, *sizes, shapes)
        textures = [*geometry, *draft.textures]
        if settings.lod_ratios is None:
            lods = tuple(near_enough(lods))  # what is drawn may be further off than what was decimated
        chain = dataclasses.replace(chain, lods=lods)
        normal_uvs = baking.level_normal_uvs(chain.lods)
        stage.delta = ", ".join(f"{t.name} {t.size[0]}×{t.size[1]}" for t in geometry)
    warnings = (
        *character.warnings,
        *stored.warnings,
        *baking.notes,
        *chain.warnings,
        *_missed_levels(chain, settings),
    )
    with progress.stage("write"):
        manifest = write_folder(
            folder, character, stored, textures, chain, settings, warnings, progress.seconds, normal_uvs
        )
    pictures = baking.draw_decisions() if settings.report else {}
    return _Try(folder, manifest, stored.mesh.surface, pictures)


def draw_groups(character: Character, face_materials: Ints) -> Ints | None:
    """Faces that need different GL state (alpha, sidedness, lighting), numbered, (F,) int32; None if all are alike."""
    states = [(m.alpha_mode, m.alpha_cutoff, m.double_sided, m.unlit) for m in character.materials]
    numbers = {state: number for number, state in enumerate(dict.fromkeys(states))}
    groups = np.array([numbers[state] for state in states], np.int32)[face_materials]
    return None if (groups == groups[:1]).all() else groups


def _build_lods(
    character: Character, atlas: Atlas, textures: list[StoredTexture], poses: Floats, settings: Settings
) -> Chain:
    """The chain of levels, costed and measured in the sampled poses."""
    mesh = atlas.mesh
    # Levels are costed where the surface is: what the stored texture misses is made up for by `fit_levels`.
    position = bake_surface_positions(mesh, (SURFACE_PX, SURFACE_PX))
    dense = mesh.dense_weights(poses.shape[1])
    blended = np.einsum("vj,pjik->pvik", dense, poses[:, :, :3])
    shifts = shift_vertices(mesh.morphs, choose_shapes(mesh.morphs, mesh.num_vertices), mesh.num_vertices)
    blended = np.concatenate([blended, shaped_matrices(blended[0], shifts)])
    options = DecimateOptions(
        ratios=None if settings.lod_ratios is None else (1.0, *settings.lod_ratios),
        relaxed_px=0.0 if settings.exact else DecimateOptions().relaxed_px,
        texture_px=max(max(t.size) for t in textures),
    )
    return decimate(
        mesh.surface,
        options,
        position_texture=position,
        poses=blended,
        face_groups=draw_groups(character, mesh.face_materials),
    )


def _missed_levels(chain: Chain, settings: Settings) -> list[str]:
    """What became of levels that were asked for below the floor."""
    if settings.lod_ratios is None or chain.floor_faces < 0:
        return []
    wanted = round(settings.lod_ratios[-1] * chain.lods[0].num_faces)
    return [
        f"levels end at {chain.floor_faces} faces, not {wanted}: seams stay exact only so far (--lods auto relaxes)"
    ]
