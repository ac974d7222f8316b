"""Image files in and out, all through OpenImageIO: PNG, TIFF, EXR, JPEG and the rest."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.errors import InputError
from preprocess.files.quiet import quiet_libraries
from runtime.errors import AssetError
from runtime.gltf.limits import LIMITS, Limits
from runtime.gltf.local_files import read_regular
from runtime.gltf.png_check import find_png_fault, first_line


@dataclass(frozen=True)
class Image:
    """Texels with what is needed to write them back as they came.

    Attributes
    ----------
    texels : (H, W, C) float32 or float64, uint8 or uint16
        Integer formats are scaled to [0, 1], or kept as stored (`read_image` with native); float formats are as
        stored.
    format : str
        Stored type of a channel: "uint8", "uint16", "half" or "float".
    channel_names : tuple of str
    metadata : Any
        OpenImageIO's ImageSpec of the source (colour space, resolution, text), or None.
    """

    texels: NDArray[Any]
    format: str = "uint8"
    channel_names: tuple[str, ...] = ()
    metadata: Any = field(default=None, compare=False)

    @property
    def levels(self) -> int:
        """Number of steps an integer format has above zero (255, 65535); 0 for float formats."""
        return {"uint8": 255, "uint16": 65535}.get(self.format, 0)


def read_image(
    source: Path | bytes,
    what: str = "image",
    *,
    native: bool = False,
    limits: Limits = LIMITS,
    most_texels: int | None = None,
) -> Image:
    """Decode an image file, or the bytes of one.

    Parameters
    ----------
    source : Path or bytes
    what : str
        How error messages name the image.
    native : bool
        Keep 8- and 16-bit integers as they are.
    limits : Limits
    most_texels : int, optional
        Of the image, asked before it is decoded; the limit's by default.

    Raises
    ------
    InputError
        If it is missing, too large, does not decode or holds values that are not finite.
    """
    most = limits.image_texels if most_texels is None else most_texels
    if isinstance(source, bytes):  # OpenImageIO's Python module reads files only
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / _guess_name(source, what)
            path.write_bytes(source)
            return _decode(path, what, native, limits, most)
    return _decode(source, what, native, limits, most)


def _decode(source: Path, what: str, native: bool, limits: Limits, most: int) -> Image:
    try:
        data = read_regular(source, limits.file_bytes)
    except AssetError as error:
        raise InputError(error) from None
    fault = find_png_fault(data)
    if fault:
        raise InputError(f"{what} does not decode: {fault}: save it again")
    with quiet_libraries():
        image = _decode_file(source, what, native, most)
    check_finite(image.texels, what)
    return image


def check_finite(texels: NDArray[Any], what: str) -> None:
    """Refuse texels (H, W, C) that are no numbers.

    Raises
    ------
    InputError
        With the first that is not.
    """
    if texels.dtype.kind == "f" and not np.isfinite(texels).all():
        bad = ~np.isfinite(texels)
        row, column, channel = (int(a[0]) for a in np.nonzero(bad))
        raise InputError(
            f"{what}: {int(bad.sum())} texel values are not finite (the first at column {column}, row {row}, "
            f"channel {channel}): repair the image first"
        )


def _decode_file(source: Path, what: str, native: bool, most_texels: int) -> Image:
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(source), config)
    if reader is None:
        message = _reason(first_line(oiio.geterror, ""), source)
        raise InputError(f"{what} does not decode ({message}): save it as PNG, JPEG, TIFF or EXR")
    try:
        spec = reader.spec()
        stored = str(spec.format)
        if spec.depth > 1 or spec.width * spec.height * max(1, spec.nchannels / 4) > most_texels:
            raise InputError(
                f"{what} is {spec.width} x {spec.height} x {spec.depth} of {spec.nchannels} channels, too large: make "
                "it smaller, or raise --limit image_texels=N"
            )
        kept = native and stored in ("uint8", "uint16")
        texels = reader.read_image(0, 0, 0, spec.nchannels, stored if kept else "float")
        if texels is None:
            raise InputError(f"{what} does not decode ({first_line(reader.geterror, 'no texels')}): it is damaged")
    finally:
        reader.close()
    fmt = {"uint8": "uint8", "uint16": "uint16", "half": "half", "float": "float", "double": "float"}.get(stored)
    if fmt is None:
        raise InputError(f"{what} stores {stored} texels: convert it to 8 or 16 bits or to float")
    texels = np.asarray(texels, stored if kept else np.float32).reshape(spec.height, spec.width, spec.nchannels)
    return Image(texels, fmt, tuple(spec.channelnames), spec)


# First bytes of image files -> a name that tells OpenImageIO the format.
_SIGNATURES = {
    b"\x89PNG": "a.png",
    b"\xff\xd8\xff": "a.jpg",
    b"RIFF": "a.webp",
    b"v/1\x01": "a.exr",
    b"II*\0": "a.tif",
    b"MM\0*": "a.tif",
    b"BM": "a.bmp",
    b"GIF8": "a.gif",
    b"DDS ": "a.dds",
}


def _guess_name(data: bytes, what: str) -> str:
    for signature, name in _SIGNATURES.items():
        if data.startswith(signature):
            return name
    found = "a KTX2 file" if data.startswith(b"\xabKTX 20") else "no image of a known format"
    raise InputError(f"{what} is {found}: save it as PNG, JPEG, TIFF or EXR")


def write_image(path: Path, image: Image) -> None:
    """Encode an image by its file name's extension, rounding integer formats to the nearest step.

    Raises
    ------
    InputError
        If the extension is not one that OpenImageIO writes or the file cannot be written.
    """
    import OpenImageIO as oiio

    texels = image.texels
    height, width, channels = texels.shape
    dtype: Any
    if texels.dtype.kind == "u":
        data = texels
    elif image.levels:
        dtype = np.uint8 if image.levels == 255 else np.uint16
        data = np.clip(np.rint(texels.astype(np.float64) * image.levels), 0, image.levels).astype(dtype)
    else:
        data = texels.astype(np.float16 if image.format == "half" else np.float32)
    spec = oiio.ImageSpec(width, height, channels, image.format)
    if image.metadata is not None:
        spec = oiio.ImageSpec(image.metadata)
        spec.width, spec.height, spec.nchannels = width, height, channels
        spec.set_format(image.format)
    if len(image.channel_names) == channels:
        spec.channelnames = image.channel_names
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if path.suffix.lower() == ".exr":
        spec.attribute("compression", "zip")
        spec.attribute("DateTime", "1970:01:01 00:00:00")  # else the time of writing: no two files would be the same
    if path.suffix.lower() == ".png":
        spec.attribute("png:compressionLevel", 6)
    writer = oiio.ImageOutput.create(str(path))
    if writer is None:
        raise InputError(f"cannot write {path.name}: use .png, .tif, .exr or .jpg")
    if not writer.open(str(path), spec):
        raise InputError(f"cannot write {path.name}: {_reason(writer.geterror(), path)}")
    written = writer.write_image(np.ascontiguousarray(data))
    error = writer.geterror()
    if not writer.close() or not written:
        raise InputError(f"cannot write {path.name} ({_reason(error or writer.geterror(), path)}): is the disk full?")
    if path.suffix.lower() == ".png" and find_png_fault(path.read_bytes()):  # a full disk goes unnoticed by libpng
        raise InputError(f"cannot write {path.name}: the disk took a part of it alone: make room")


def _reason(error: str, path: Path) -> str:
    """OpenImageIO's first line on what went wrong, without the temporary folder that files are first written to."""
    lines = error.splitlines() or ["for an unknown reason"]
    return lines[0].replace(str(path), path.name)
