"""The tools on plain arrays: what the commands do, for programs and notebooks.

Letters in shapes: V vertices, T texture coordinates, F triangles, S seam edges, H × W texels, C channels. Index arrays
may have any integer type; an image may be (H, W) or (H, W, C), of 8- or 16-bit integers or floats, and comes back in
its own shape and type. Where `face_uvs` is left out, each vertex has one texture coordinate.

>>> import numpy as np
>>> positions = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)]
>>> faces = [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)]
>>> uvs = [(.1, .1), (.4, .1), (.4, .5), (.1, .5), (.6, .2), (.9, .2), (.9, .6), (.6, .6)]
>>> face_uvs = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
>>> seams = find_seams(positions, faces, uvs, face_uvs)
>>> seams.vertices.tolist()
[[1, 4]]
>>> image = np.random.default_rng(1).integers(0, 256, (64, 64, 3)).astype(np.uint8)
>>> before = measure_seams(image, positions, faces, uvs, face_uvs)
>>> result = erase(image, positions, faces, uvs, face_uvs)
>>> bool(before.max.max() > 100 and result.after.max.max() < 0.5)  # in steps of 255
True
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from preprocess.arrays import Floats, Ints
from preprocess.mesh.surface import TexturedSurface
from preprocess.settings import Settings


class SeamEdges(NamedTuple):
    """The uv silhouette of a mesh. S seam edges, B boundary edges.

    Attributes
    ----------
    vertices : (S, 2) int32
        Vertices at the two ends of each seam edge.
    uv_pairs : (S, 2, 2) int32
        Texture coordinates, [seam, side, end]: both sides run from the same vertex to the same vertex.
    faces : (S, 2) int32
        The triangle on each side.
    lengths : (S,) float64
        3D lengths, in the unit of the positions.
    boundary_vertices, boundary_uvs : (B, 2) int32
        Ends of the edges that have one triangle.
    """

    vertices: Ints
    uv_pairs: NDArray[np.int32]
    faces: Ints
    lengths: Floats
    boundary_vertices: Ints
    boundary_uvs: Ints


class SeamJump(NamedTuple):
    """How far an image jumps across seams, in its own unit (steps of an integer image). C channels.

    Attributes
    ----------
    rms : (C,) float64
        Root of the mean squared jump over the seams' 3D length, integrated exactly (paper, equation for D_total).
    max : (C,) float64
        Largest jump.
    """

    rms: Floats
    max: Floats


class ErasedImage(NamedTuple):
    """An image whose bilinear samples agree across seams.

    Attributes
    ----------
    image : (H, W) or (H, W, C)
        Of the shape and type that was given.
    before, after : SeamJump
        Of the image given and of the one returned, as stored.
    """

    image: NDArray[Any]
    before: SeamJump
    after: SeamJump


class StraightenedMesh(NamedTuple):
    """A mesh whose seams run straight, equally on both sides.

    Attributes
    ----------
    positions : (V', 3) float64
    faces : (F', 3) int32
    uvs : (T', 2) float64
    face_uvs : (F', 3) int32
        The mesh given, with some edges split at their midpoints.
    old_uvs : (T', 2) float64
        The same points in the uvs that were given: an image moves from these to `uvs`.
    face_source : (F',) int32
        The given triangle that each triangle lies in.
    num_edges, num_runs : int
        Edges of the uv silhouette, and the straight runs that they now form.
    """

    positions: Floats
    faces: Ints
    uvs: Floats
    face_uvs: Ints
    old_uvs: Floats
    face_source: Ints
    num_edges: int
    num_runs: int


class DecimatedMesh(NamedTuple):
    """A mesh with fewer triangles in the same texture.

    Attributes
    ----------
    positions : (V', 3) float64
    faces : (F', 3) int32
    uvs : (T', 2) float64
    face_uvs : (F', 3) int32
    face_source : (F',) int32
        A given triangle that each triangle stems from, for its material.
    error : float
        Largest distance to the mesh given, in the unit of the positions; NaN where a number of faces was asked for.
    warnings : tuple of str
        What was repaired, and why fewer triangles were not reached.
    """

    positions: Floats
    faces: Ints
    uvs: Floats
    face_uvs: Ints
    face_source: Ints
    error: float
    warnings: tuple[str, ...]


def _vectors(values: ArrayLike, size: int, name: str) -> Floats:
    """An (N, size) array of finite numbers."""
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != size or array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be an array of numbers of shape (N, {size}), not {array.dtype} {array.shape}")
    result = np.ascontiguousarray(array, np.float64)
    if not np.isfinite(result).all():
        raise ValueError(f"{name} holds numbers that are not finite (the first in row {_first_bad(result)})")
    return result


def _first_bad(values: Floats) -> int:
    return int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])


def _triangles(values: ArrayLike, count: int, name: str, into: str) -> Ints:
    """An (F, 3) array of indices below `count`."""
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
        raise ValueError(f"{name} must be an array of integers of shape (F, 3), not {array.dtype} {array.shape}")
    if array.size and not (0 <= int(array.min()) and int(array.max()) < count):
        hint = ": they count from 0" if int(array.min()) == 1 and int(array.max()) == count else ""
        raise ValueError(f"{name} must lie in 0 … {count - 1}, the {into}, not {array.min()} … {array.max()}{hint}")
    return np.ascontiguousarray(array, np.int32)


def _surface(positions: ArrayLike, faces: ArrayLike, uvs: ArrayLike, face_uvs: ArrayLike | None) -> TexturedSurface:
    """Arrays of a caller as a mesh.

    Raises
    ------
    ValueError
        If an array has another shape or kind, an index is out of range, or a number is not finite.
    """
    points, texture_points = _vectors(positions, 3, "positions"), _vectors(uvs, 2, "uvs")
    triangles = _triangles(faces, len(points), "faces", "positions")
    if face_uvs is None:
        if len(texture_points) != len(points):
            raise ValueError(
                f"{len(texture_points)} uvs for {len(points)} positions: give face_uvs, or one uv per position"
            )
        face_uvs = triangles
    texture_triangles = _triangles(face_uvs, len(texture_points), "face_uvs", "uvs")
    if len(texture_triangles) != len(triangles):
        raise ValueError(f"{len(texture_triangles)} face_uvs for {len(triangles)} faces: one row per face is needed")
    return TexturedSurface(points, triangles, texture_points, texture_triangles)


def _texels(image: ArrayLike) -> NDArray[Any]:
    """An image as (H, W, C) of 8- or 16-bit integers or of floats."""
    array = np.asarray(image)
    if array.ndim not in (2, 3) or 0 in array.shape:
        raise ValueError(f"an image has the shape (H, W) or (H, W, C), not {array.shape}")
    if array.dtype not in (np.uint8, np.uint16) and array.dtype.kind != "f":
        raise ValueError(f"an image holds uint8, uint16 or floats, not {array.dtype}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError("an image holds numbers that are not finite")
    return array.reshape(*array.shape[:2], -1)


def find_seams(positions: ArrayLike, faces: ArrayLike, uvs: ArrayLike, face_uvs: ArrayLike | None = None) -> SeamEdges:
    """Find the edges whose two sides have different texture coordinates (paper, section 3).

    Parameters
    ----------
    positions : (V, 3) float
    faces : (F, 3) int, into positions
    uvs : (T, 2) float
        glTF's convention: origin at the top left, v down.
    face_uvs : (F, 3) int, into uvs, optional

    Returns
    -------
    SeamEdges

    Raises
    ------
    ValueError
        If an array is malformed.
    """
    from preprocess.mesh import seams

    found = seams.find_seams(_surface(positions, faces, uvs, face_uvs), join_crowded=True)
    return SeamEdges(
        found.vertices, found.uv_pairs, found.faces, found.lengths_m, found.boundary_vertices, found.boundary_uvs
    )


def measure_seams(
    image: ArrayLike, positions: ArrayLike, faces: ArrayLike, uvs: ArrayLike, face_uvs: ArrayLike | None = None
) -> SeamJump:
    """Measure how far an image jumps across the seams of a mesh, as a bilinear sampler shows it.

    Parameters
    ----------
    image : (H, W) or (H, W, C), uint8, uint16 or float
    positions, faces, uvs, face_uvs
        See `find_seams`. Where uvs leave [0, 1] the sampler repeats, else it clamps.

    Returns
    -------
    SeamJump
        In the image's own unit: steps for integers.

    Raises
    ------
    ValueError
        If an array is malformed.
    """
    from preprocess.erase.seam_samples import measure_seams as measure
    from preprocess.mesh.seams import find_seams as find

    surface = _surface(positions, faces, uvs, face_uvs)
    seams = find(surface, join_crowded=True)
    found = measure(_texels(image), surface, seams, repeat=_repeats(surface))
    return SeamJump(found.rms, found.max)


def _repeats(surface: TexturedSurface) -> bool:
    """Whether uvs leave the image, so that samples wrap round."""
    return bool(len(surface.uvs) and (surface.uvs.min() < 0 or surface.uvs.max() > 1))


def erase(
    image: ArrayLike,
    positions: ArrayLike,
    faces: ArrayLike,
    uvs: ArrayLike,
    face_uvs: ArrayLike | None = None,
    *,
    spread: str = "local",
    seam_value: str = "none",
    joined: ArrayLike | None = None,
) -> ErasedImage:
    """Change an image as little as possible such that its samples agree on both sides of every seam.

    Parameters
    ----------
    image : (H, W) or (H, W, C), uint8, uint16 or float
        One, with any number of channels: all are solved at once.
    positions, faces, uvs, face_uvs
        See `find_seams`.
    spread : "local" or "global"
        How far from the seams the change reaches: a few texels, or the whole charts (paper, section 4).
    seam_value : "none", "lerp" or "texture"
        Whether values along the seams are held near those that run linearly between the vertices, or near the image.
    joined : (S,) bool, optional
        Which seams of `find_seams` to close; all by default.

    Returns
    -------
    ErasedImage

    Raises
    ------
    ValueError
        If an array is malformed, or an option unknown.

    References
    ----------
    Liu, Ferguson, Jacobson, Gingold 2017: Seamless, section 4.
    """
    from preprocess.erase.options import GLOBAL, LOCAL, EraseOptions
    from preprocess.erase.prepare import plan_erasure
    from preprocess.mesh.seams import find_seams as find

    weights = {"local": LOCAL, "global": GLOBAL}
    if spread not in weights:
        raise ValueError(f"no spread {spread!r}: local or global")
    if seam_value not in ("none", "lerp", "texture"):
        raise ValueError(f"no seam_value {seam_value!r}: none, lerp or texture")
    texels, surface = _texels(image), _surface(positions, faces, uvs, face_uvs)
    seams = find(surface, join_crowded=True)
    chosen = None if joined is None else np.asarray(joined, np.bool_)
    if chosen is not None and chosen.shape != (len(seams.vertices),):
        raise ValueError(f"joined must say yes or no for each of {len(seams.vertices)} seams, not {chosen.shape}")
    options = EraseOptions(weights=weights[spread], seam_value=seam_value, joined=chosen, repeat=_repeats(surface))
    eraser = plan_erasure(surface, seams, texels.shape[1], texels.shape[0], options)
    is_integer = texels.dtype.kind == "u"
    given = texels if is_integer else texels.astype(np.float64)
    erased = eraser.erase_stored(given) if is_integer else eraser.erase(given)
    stored = erased.texels.astype(texels.dtype)
    before, after = eraser.measure(texels), eraser.measure(stored)
    return ErasedImage(
        stored.reshape(np.shape(image)), SeamJump(before.rms, before.max), SeamJump(after.rms, after.max)
    )


def straighten(
    positions: ArrayLike,
    faces: ArrayLike,
    uvs: ArrayLike,
    face_uvs: ArrayLike | None = None,
    *,
    tolerance: float = 0.01,
) -> StraightenedMesh:
    """Make seams straight where they nearly are, equally on both sides, so that their edges can collapse.

    Parameters
    ----------
    positions, faces, uvs, face_uvs
        See `find_seams`.
    tolerance : float
        How far a seam may move, as a fraction of its bounding box.

    Returns
    -------
    StraightenedMesh

    Raises
    ------
    ValueError
        If an array is malformed or the tolerance negative.
    InputError
        If an edge has three or more triangles.

    References
    ----------
    Liu, Ferguson, Jacobson, Gingold 2017: Seamless, section 6.
    """
    from preprocess.straighten import straighten as run

    found = run(_surface(positions, faces, uvs, face_uvs), tolerance)
    surface = found.surface
    return StraightenedMesh(
        *(surface.positions, surface.faces, surface.uvs, surface.face_uvs),
        old_uvs=found.split.surface.uvs,
        face_source=np.asarray(found.split.face_source, np.int32),
        num_edges=found.num_edges,
        num_runs=found.num_runs,
    )


def decimate(
    positions: ArrayLike,
    faces: ArrayLike,
    uvs: ArrayLike,
    face_uvs: ArrayLike | None = None,
    *,
    num_faces: int | None = None,
    error: float | None = None,
    strict: str = "seamless",
) -> DecimatedMesh:
    """Collapse edges while every seam keeps its lines in the texture.

    Parameters
    ----------
    positions, faces, uvs, face_uvs
        See `find_seams`.
    num_faces : int, optional
        Triangles to come down to.
    error : float, optional
        Instead: the largest distance to the mesh given that is allowed, in the unit of the positions.
    strict : "seamless", "shape" or "none"
        What of the uv map is kept: outlines and the parametrisation along both sides of seams, outlines alone, or the
        charts' topology alone.

    Returns
    -------
    DecimatedMesh

    Raises
    ------
    ValueError
        If an array is malformed, or not one of `num_faces` and `error` is given.
    InputError
        If the target cannot be.

    References
    ----------
    Liu, Ferguson, Jacobson, Gingold 2017: Seamless, section 5.
    """
    from preprocess.decimate import DecimateOptions, Strictness, decimate_to, decimate_within

    if (num_faces is None) == (error is None):
        raise ValueError("give either num_faces or error")
    if strict not in {kind.value for kind in Strictness}:
        raise ValueError(f"no strictness {strict!r}: seamless, shape or none")
    surface = _surface(positions, faces, uvs, face_uvs)
    options = DecimateOptions(strict=Strictness(strict))
    if num_faces is not None:
        chain = decimate_to(surface, num_faces, options)
    else:
        assert error is not None
        chain = decimate_within(surface, error, options)
    lod = chain.lods[-1]
    return DecimatedMesh(
        *(lod.positions, lod.faces, lod.uvs, lod.face_uvs, lod.face_source), lod.error_m, chain.warnings
    )


def build(model: str | os.PathLike[str], output: str | os.PathLike[str], **settings: Any) -> Sequence[str]:
    """Build a character's folder, as `python -m preprocess MODEL -o DIR` does.

    Parameters
    ----------
    model : path
        .gltf, .glb or .vrm.
    output : path
        Folder, replaced as a whole when everything has succeeded.
    settings
        Fields of `preprocess.settings.Settings`.

    Returns
    -------
    sequence of str
        Warnings: everything that was changed, dropped or approximated.

    Raises
    ------
    InputError
        If the file cannot be used or the folder not be written.
    TypeError
        If there is no such setting.
    """
    from preprocess.files.output_folder import check_destination
    from preprocess.pipeline import build as run
    from preprocess.progress import Progress

    destination = Path(output)
    check_destination(destination)
    return run(Path(model), destination, Settings(**settings), Progress(quiet=True)).warnings
