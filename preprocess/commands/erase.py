"""`python -m preprocess erase MESH IMAGE... -o OUT`: seam erasure alone, for texture artists."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.commands.build_arguments import add_limit_argument, limits_from
from preprocess.erase.eraser import Eraser
from preprocess.erase.mips import erase_mips
from preprocess.erase.options import GLOBAL, LOCAL, EraseOptions
from preprocess.erase.prepare import plan_erasure
from preprocess.erase.seam_classification import Decision, choose_color_seams, draw_decision
from preprocess.erase.seam_samples import SeamMeasure
from preprocess.errors import InputError
from preprocess.files.images import Image, read_image, write_image
from preprocess.files.output_folder import check_not_input, partial_folder
from preprocess.files.quiet import quiet_libraries
from preprocess.mesh.seams import Seams, count_crowded_edges, find_seams
from preprocess.mesh.surface import TexturedSurface
from runtime.errors import AssetError
from runtime.gltf.limits import Limits
from runtime.gltf.local_files import check_regular
from runtime.gltf.png_check import first_line

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = {".png", ".tif", ".tiff", ".exr", ".jpg", ".jpeg", ".tga", ".bmp", ".webp", ".hdr", ".dpx", ".jp2"}
LOSSY_SUFFIXES = {".jpg", ".jpeg", ".webp", ".gif"}

# Memory that a build takes beside the image: the programs' libraries, and what each texel of seam length costs in
# unknowns, matrix and factor (measured: 7 kB on Fox and blub).
BASE_BYTES = 110 << 20
BYTES_PER_SEAM_PX = 8_000
MIP_BYTES_PER_VALUE = 24


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("mesh", type=Path, metavar="MESH", help="OBJ or glTF mesh whose uvs the images use")
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help="PNG, TIFF, EXR, JPEG ... images")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT", help="image file (one IMAGE) or folder to write"
    )
    parser.add_argument(
        "--global", dest="is_global", action="store_true", help="spread the differences over the whole charts"
    )
    parser.add_argument(
        "--seam-value",
        choices=["none", "lerp", "texture"],
        default="none",
        help="hold the seams near values that run linearly between vertices, or near the texture as it is "
        "(texels outside the charts are reliable)",
    )
    parser.add_argument("--mips", action="store_true", help="also write a mip chain whose every level is seamless")
    parser.add_argument(
        "--keep-borders",
        type=float,
        default=None,
        metavar="T",
        help="leave seams whose sides differ by more than T (0 to 1): borders painted on purpose",
    )
    parser.add_argument(
        "--report", type=Path, default=None, metavar="PNG", help="picture of the seams joined (green) and left (red)"
    )
    add_limit_argument(parser)


def _available_bytes() -> int | None:
    """Memory that this process may still take, or None where the system does not tell."""
    limits = []
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        limits.append(next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")))
    with contextlib.suppress(OSError, ValueError):  # a container's own limit; "max" where there is none
        group = Path("/sys/fs/cgroup")
        limits.append(int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    with contextlib.suppress(ImportError, OSError, ValueError, IndexError):
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most != resource.RLIM_INFINITY:
            limits.append(most - int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize())
    return max(min(limits), 0) if limits else None


def _read_size(path: Path) -> tuple[int, int, int, str]:
    """Width, height, channels and stored type of an image file, from its header alone."""
    import OpenImageIO as oiio

    try:
        check_regular(path)
    except AssetError as error:
        raise InputError(error) from None
    with quiet_libraries():
        reader = oiio.ImageInput.open(str(path))
        if reader is None:
            reason = first_line(oiio.geterror, "unknown format")
            raise InputError(f"{path.name} does not decode ({reason}): save it as PNG, JPEG, TIFF or EXR")
        spec = reader.spec()
        reader.close()
    return spec.width, spec.height, spec.nchannels, str(spec.format)


def _check_memory(path: Path, surface: TexturedSurface, seams: Seams, mips: bool) -> None:
    """Refuse an image that this machine's memory cannot hold while it is erased."""
    width, height, channels, stored = _read_size(path)
    per_texel = {"uint8": 3 * channels, "uint16": 6 * channels}.get(stored, 20 * channels) + 2
    if mips:
        per_texel += MIP_BYTES_PER_VALUE * channels
    lines = surface.uvs[seams.uv_pairs] * (width, height)
    seam_px = float(np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=2).sum())
    needed = BASE_BYTES + width * height * per_texel + int(BYTES_PER_SEAM_PX * seam_px)
    available = _available_bytes()
    if available is not None and needed > available:
        raise InputError(
            f"{path.name} is {width} x {height}: erasing it needs about {needed / 1e9:.1f} GB of memory and "
            f"{available / 1e9:.1f} GB are free: use a smaller image or a larger machine"
        )


def _read_mesh(path: Path, limits: Limits) -> tuple[TexturedSurface, Seams, bool]:
    """Mesh, seams, and whether its uvs leave the image, so that samples wrap."""
    from preprocess.load.read_surface import read_surface

    surface = read_surface(path, limits)
    if not len(surface.faces) or not len(surface.uvs):
        raise InputError(f"{path.name}: no faces with texture coordinates: unwrap the mesh first")
    wraps = bool(surface.uvs.min() < 0 or surface.uvs.max() > 1)
    if wraps:
        print(f"note: {path.name} has uvs outside [0, 1]: they wrap round, as with a repeating sampler")
    num_crowded = count_crowded_edges(surface)
    if num_crowded:
        print(f"note: {num_crowded} mesh edges have three or more faces: the image is joined across all of them")
    return surface, find_seams(surface, join_crowded=True), wraps


def _output_paths(images: list[Path], output: Path, mips: bool) -> list[Path]:
    """File to write for every image."""
    if output.suffix.lower() in IMAGE_SUFFIXES and not output.is_dir():
        if len(images) > 1:
            raise InputError(f"{output} is one file for {len(images)} images: name a folder with -o")
        paths = [output]
    else:
        if output.is_file():
            raise InputError(f"{output} is a file without an image's extension: name a folder or an image with -o")
        paths = [output / path.name for path in images]
    if len(set(paths)) < len(paths):
        raise InputError("two images have the same name: erase them in two calls")
    for path in paths:
        if path.suffix.lower() in LOSSY_SUFFIXES:
            print(f"note: {path.name} is stored with losses, which open seams again a little: prefer .png")
    return paths


def _describe(before: SeamMeasure, stored: SeamMeasure, unit: float, name: str, stays: bool) -> str:
    """One line on what erasure did."""
    if stays:
        return f"{name}: no seams to erase: written as it is"
    what = f" of {unit:.0f}" if unit > 1 else ""
    return (
        f"{name}: jump across seams rms {before.rms.max() * unit:.4g} to {stored.rms.max() * unit:.4g}, "
        f"largest {before.max.max() * unit:.4g} to {stored.max.max() * unit:.4g}{what}"
    )


class _Job:
    """One mesh, its options, and the erasers made so far: images of one size share one."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.surface, self.seams, wraps = _read_mesh(arguments.mesh, limits_from(arguments))
        self.options = EraseOptions(
            weights=GLOBAL if arguments.is_global else LOCAL, seam_value=arguments.seam_value, repeat=wraps
        )
        self.threshold = np.inf if arguments.keep_borders is None else arguments.keep_borders
        self.mips = arguments.mips
        self.report: Path | None = arguments.report
        self.plans: dict[bytes, dict[tuple[int, int], Eraser]] = {}

    def erase(self, image: Image, name: str) -> list[Image]:
        """The erased image, and its mip levels where asked for."""
        texels = image.texels
        unit = float(np.iinfo(texels.dtype).max) if texels.dtype.kind == "u" else 1.0
        decision = self._decide(texels, unit)
        options = replace(self.options, joined=decision.joined)
        plans = self.plans.setdefault(decision.joined.tobytes(), {})
        height, width = texels.shape[:2]
        if (width, height) not in plans:
            plans[width, height] = plan_erasure(self.surface, self.seams, width, height, options)
        plan = plans[width, height]
        stays = plan.factor is None
        if self.mips:
            values = texels / np.float32(unit) if unit > 1 else texels
            chain = erase_mips(
                values, self.surface, self.seams, options, levels=image.levels,
                srgb_channels=_num_srgb_channels(image), plans=plans,
            )  # fmt: skip
            levels = [level.texels for level in chain]
        elif stays:
            levels = [texels]
        else:
            levels = [plan.erase_stored(texels).texels if unit > 1 else plan.erase(texels).texels]
        if unit == 1.0:
            levels = [level.astype(np.float32) for level in levels]
        written = levels[0].astype(np.float16) if image.format == "half" else levels[0]
        print(_describe(plan.measure(texels, unit), plan.measure(written, unit), unit, name, stays))
        if decision.num_left:
            print(f"{name}: {decision.num_left} of {len(decision.joined)} seams left: they differ by more than "
                  f"{decision.threshold:g}")  # fmt: skip
        if self.report is not None:
            print(f"{self.report}: the {len(decision.joined) - decision.num_left} joined seams in green, "
                  f"{decision.num_left} left in red (--keep-borders {decision.threshold:g})")  # fmt: skip
            self._picture(texels / np.float32(unit), decision)
        return [replace(image, texels=level) for level in levels]

    def _decide(self, texels: NDArray[Any], unit: float) -> Decision:
        if np.isinf(self.threshold):
            num = len(self.seams.vertices)
            return Decision(np.ones(num, np.bool_), np.zeros(num), np.inf)
        decision = choose_color_seams(
            texels, self.surface, self.seams, self.threshold * unit, repeat=self.options.repeat
        )
        return replace(decision, threshold=self.threshold)

    def _picture(self, texels: NDArray[Any], decision: Decision) -> None:
        assert self.report is not None
        self.report.parent.mkdir(parents=True, exist_ok=True)
        write_image(self.report, Image(draw_decision(texels, self.surface, self.seams, decision)))


def _num_srgb_channels(image: Image) -> int:
    """How many leading channels hold sRGB values: the colours of 8-bit and of sRGB-tagged images."""
    space = ""
    if image.metadata is not None:
        space = str(image.metadata.get_string_attribute("oiio:ColorSpace")).lower()
    is_srgb = "srgb" in space or (space == "" and image.format == "uint8")
    channels = image.texels.shape[2]
    return (channels if channels in (1, 3) else channels - 1) if is_srgb else 0


def _write_level(folder: Path, name: Path, level: int, image: Image) -> Path:
    """Write one level under its final name in a temporary folder; return its relative path."""
    relative = Path(name.name) if level == 0 else Path("mips") / f"{name.stem}.{level}{name.suffix}"
    (folder / relative).parent.mkdir(exist_ok=True)
    write_image(folder / relative, image)
    return relative


def run(arguments: argparse.Namespace) -> None:
    """Erase the seams of all images; all files appear at the end, or none.

    Raises
    ------
    InputError
        If the mesh or an image cannot be used, or the output cannot be written.
    """
    paths = _output_paths(arguments.images, arguments.output, arguments.mips)
    for path in paths:
        check_not_input(path, arguments.images)
    job = _Job(arguments)
    for source in arguments.images:
        _check_memory(source, job.surface, job.seams, arguments.mips)
    if not len(job.seams.vertices):
        print(f"note: {arguments.mesh.name} has no seams: images are copied as they are")
    folder = paths[0].absolute().parent
    with partial_folder(folder, "erase") as partial:
        made: list[Path] = []
        for source, path in zip(arguments.images, paths, strict=True):
            image = read_image(source, source.name, native=True, limits=limits_from(arguments))
            levels = job.erase(image, source.name)
            if not len(job.seams.vertices) and len(levels) == 1 and source.suffix == path.suffix:
                shutil.copyfile(source, partial / path.name)
                made.append(Path(path.name))
                continue
            made += [_write_level(partial, path, number, level) for number, level in enumerate(levels)]
        for relative in made:
            (folder / relative).parent.mkdir(exist_ok=True)
            os.replace(partial / relative, folder / relative)
