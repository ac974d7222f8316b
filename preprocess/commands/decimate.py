"""`python -m preprocess decimate MESH -o OUT.obj`: one simplified mesh that keeps its textures."""

from __future__ import annotations

import argparse
from pathlib import Path

from preprocess.commands.build_arguments import add_limit_argument, limits_from
from preprocess.decimate.chain import check_target, decimate_to, decimate_within
from preprocess.decimate.levels import Chain, DecimateOptions, Strictness
from preprocess.decimate.topology import check_surface
from preprocess.errors import InputError
from preprocess.files.obj import read_looks, write_obj
from preprocess.files.obj_materials import ObjLooks
from preprocess.files.output_folder import check_not_input
from preprocess.load.read_surface import read_surface
from preprocess.mesh.surface import TexturedSurface
from preprocess.progress import tell_of_compiling

TOLERANCE_PX, MOST_SEAM_TEXELS = 1024, 16  # the texture that --seam-tolerance is counted in, and how many at most


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("mesh", type=Path, metavar="MESH", help="OBJ or glTF mesh with texture coordinates")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.obj", help="mesh to write")
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--faces", type=int, metavar="N", help="triangles to come down to")
    target.add_argument("--ratio", type=float, metavar="R", help="the same as a fraction of the mesh's, 0 to 1")
    target.add_argument("--error", type=float, metavar="METRES", help="largest distance from the full mesh")
    parser.add_argument(
        "--straighten",
        type=float,
        default=None,
        metavar="TOL",
        help="straighten seams first, by up to this fraction of each seam's extent (this changes the uvs: warp the "
        "images with the straighten command)",
    )
    parser.add_argument(
        "--strict",
        choices=[strictness.value for strictness in Strictness],
        default=Strictness.SEAMLESS.value,
        help="keep nothing of the uv map's outlines, their shape, or their timing too (default: seamless)",
    )
    add_limit_argument(parser)
    parser.add_argument(
        "--seam-tolerance",
        type=float,
        default=None,
        metavar="TEXELS",
        help="seams that are straight and in step to within so many texels of a 1024 x 1024 texture count as that "
        "(default: what the digits of the file's texture coordinates leave open)",
    )


def _straightened(
    surface: TexturedSurface, looks: ObjLooks | None, tolerance_rel: float | None
) -> tuple[TexturedSurface, ObjLooks | None]:
    if tolerance_rel is None:
        return surface, looks
    if not 0.0 < tolerance_rel < 0.5:
        raise InputError(f"--straighten {tolerance_rel:g} is not between 0 and 0.5: give a fraction such as 0.01")
    from preprocess.straighten import straighten

    result = straighten(surface, tolerance_rel)
    return result.surface, looks.of(result.split.face_source) if looks else None


def _seam_tolerance_uv(arguments: argparse.Namespace) -> float | None:
    texels = arguments.seam_tolerance
    if texels is None:
        return None
    if not 0.0 <= texels <= MOST_SEAM_TEXELS:
        raise InputError(f"--seam-tolerance {texels:g} is not between 0 and {MOST_SEAM_TEXELS}: give texels")
    return float(texels) / TOLERANCE_PX


def _decimated(surface: TexturedSurface, arguments: argparse.Namespace, num_faces: int) -> tuple[Chain, str]:
    """The chain and what was asked for, in words."""
    options = DecimateOptions(strict=Strictness(arguments.strict), seam_tolerance_uv=_seam_tolerance_uv(arguments))
    if arguments.error is not None:
        return decimate_within(surface, arguments.error, options), f"error {arguments.error:g} m"
    target = arguments.faces
    if arguments.ratio is not None:
        if not 0.0 < arguments.ratio <= 1.0:
            raise InputError(f"--ratio {arguments.ratio:g} is not above 0 and at most 1: give a fraction of the faces")
        target = max(1, round(arguments.ratio * num_faces))
    check_target(target, num_faces)
    return decimate_to(surface, min(target, len(surface.faces)), options), f"{target} faces"


def run(arguments: argparse.Namespace) -> None:
    """Decimate one mesh and print what was asked for and what came of it.

    Raises
    ------
    InputError
        If the mesh, the target or the output path is at fault.
    """
    if arguments.output.suffix.lower() != ".obj":
        raise InputError(f"{arguments.output}: decimated meshes are written as OBJ: give a name that ends in .obj")
    check_not_input(arguments.output, [arguments.mesh])
    source = read_surface(arguments.mesh, limits_from(arguments))
    check_surface(source)
    with tell_of_compiling():
        surface, looks = _straightened(source, read_looks(arguments.mesh, limits_from(arguments)), arguments.straighten)
        chain, requested = _decimated(surface, arguments, len(source.faces))
    lod = chain.lods[0]
    write_obj(arguments.output, lod.surface, looks.of(lod.face_source) if looks else None)
    reached = f"{lod.num_faces} faces" + (f", error {lod.error_m:.3g} m" if arguments.error is not None else "")
    print(f"{arguments.mesh.name}: {len(source.faces)} faces, requested {requested}, reached {reached}")
    for warning in chain.warnings:
        print(f"  {warning}")
    if chain.floor_faces >= 0:
        reasons = ", ".join(f"{count} {rule}" for rule, count in chain.blocked.items())
        print(f"  the floor is {chain.floor_faces} faces: no edge that is left may collapse ({reasons})")
        if arguments.straighten is None and arguments.strict == Strictness.SEAMLESS.value:
            print("  straight seams go further: --straighten 0.01")
