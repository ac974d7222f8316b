"""Command `straighten MESH [IMAGE…] -o DIR`: straight seams, and the images that live on the mesh with them."""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
from pathlib import Path

from preprocess.commands.build_arguments import add_limit_argument, limits_from
from preprocess.errors import InputError
from preprocess.files.images import Image, read_image, write_image
from preprocess.files.obj import read_looks, write_obj
from preprocess.files.obj_materials import ObjLooks, move_library
from preprocess.files.output_folder import MANIFEST, atomic_folder, check_destination, describe_contents
from preprocess.load.read_surface import read_surface
from preprocess.progress import tell_of_compiling
from preprocess.straighten.driver import DEFAULT_DISTORTION, DEFAULT_TOLERANCE_REL, Straightened, straighten
from preprocess.straighten.warp import Warp, find_warp

log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `straighten`."""
    parser.add_argument("mesh", type=Path, help="an OBJ or glTF mesh with texture coordinates")
    parser.add_argument("images", type=Path, nargs="*", metavar="IMAGE", help="images in its texture coordinates")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for mesh and images")
    parser.add_argument(
        "--tolerance",
        type=_tolerance,
        default=DEFAULT_TOLERANCE_REL,
        metavar="T",
        help="how far a seam may move, a fraction of its bounding box (default %(default)s)",
    )
    parser.add_argument(
        "--most-distortion",
        type=_distortion,
        default=DEFAULT_DISTORTION,
        metavar="D",
        help="bound on a face's change of shape, 1 and up (default %(default)s)",
    )
    add_limit_argument(parser)
    parser.add_argument("-v", "--verbose", action="store_true", help="log what is done")


def _tolerance(text: str) -> float:
    return _number(text, 0.0, 1.0, "a tolerance is a fraction from 0 to 1")


def _distortion(text: str) -> float:
    value = _number(text, 1.0, 1e6, "a distortion is a number above 1")
    if value <= 1.0:
        raise argparse.ArgumentTypeError(f"a distortion is a number above 1, not {text!r}")
    return value


def _number(text: str, least: float, most: float, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = least - 1.0
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"{what}, not {text!r}")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Straighten a mesh's seams and warp its images; the folder appears whole or not at all.

    Raises
    ------
    InputError
        If the mesh or an image is missing or does not read, two images have one name, or the folder cannot be written.
    """
    destination: Path = arguments.output
    check_destination(destination)
    names = [path.name for path in arguments.images]
    mesh_name = f"{arguments.mesh.stem}.obj"
    taken = [mesh_name, MANIFEST, *names]
    twice = sorted({name for name in taken if taken.count(name) > 1})
    if twice:
        raise InputError(f"two outputs would be named {twice[0]}: rename one of the inputs")
    surface = read_surface(arguments.mesh, limits_from(arguments))
    images = [read_image(path, path.name, limits=limits_from(arguments)) for path in arguments.images]
    with tell_of_compiling():
        result = straighten(surface, arguments.tolerance, most_distortion=arguments.most_distortion)
    with atomic_folder(destination) as folder:
        looks = read_looks(arguments.mesh, limits_from(arguments))
        if looks is not None:
            looks = _bring_libraries(looks.of(result.split.face_source), folder, destination, names)
        write_obj(folder / mesh_name, result.surface, looks)
        warps: dict[tuple[int, int], Warp] = {}
        for name, image in zip(names, images, strict=True):
            write_image(folder / name, _warp(image, result, warps))
        report = {
            **describe_contents(folder),
            "straighten": describe(result, arguments.tolerance),
            "mesh": mesh_name,
            "images": names,
        }
        (folder / MANIFEST).write_text(json.dumps(report, indent=2) + "\n")
    print(
        f"{mesh_name}: {result.num_edges} silhouette edges in {result.num_runs} straight runs, "
        f"{100.0 * result.collapsible_fraction:.1f} % of their length collapsible"
    )
    if len(result.reduced_charts):
        print(
            f"{len(result.reduced_charts)} charts: tolerance reduced in places, against folds, crossings or distortion"
        )
    if result.folded:
        print(f"{result.folded} faces are folded or have no area in the mesh's own texture coordinates and stay so")
    return 0


def _bring_libraries(looks: ObjLooks, folder: Path, destination: Path, images: list[str]) -> ObjLooks:
    """Write the mesh's material libraries beside it, naming the warped images; the looks that name these."""
    brought = []
    for library in looks.libraries:
        if library.is_file() and library.name not in (MANIFEST, *images):
            text = library.read_text(encoding="utf-8", errors="surrogateescape")
            moved = move_library(text, library.parent, destination, images)
            (folder / library.name).write_text(moved, encoding="utf-8", errors="surrogateescape")
            brought.append(folder / library.name)
    return dataclasses.replace(looks, libraries=tuple(brought))


def _warp(image: Image, result: Straightened, warps: dict[tuple[int, int], Warp]) -> Image:
    """One image in the new uvs; images of one size share the search for sources."""
    height, width = image.texels.shape[:2]
    if (width, height) not in warps:
        warps[width, height] = find_warp(result.split.surface, result.surface, width, height)
    return dataclasses.replace(image, texels=warps[width, height].apply(image.texels))


def describe(result: Straightened, tolerance_rel: float) -> dict[str, float | int]:
    """The figures of a result, as the manifest holds them."""
    return {
        "tolerance": tolerance_rel,
        "silhouette_edges": result.num_edges,
        "straight_runs": result.num_runs,
        "collapsible_length": result.collapsible_fraction,
        "floor_faces": result.floor_faces,
        "edges_split": result.split.num_edges,
        "charts_reduced": len(result.reduced_charts),
        "distortion": result.distortion,
        "folded": result.folded,
    }
