"""Image files in and out, all through OpenImageIO: PNG, TIFF, EXR, JPEG and the rest."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from preprocess.errors import InputError
from runtime.gltf.png_check import find_png_fault


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


def read_image(source: Path | bytes, what: str = "image", *, native: bool = False) -> Image:
    """Decode an image file, or the bytes of one.

    Parameters
    ----------
    source : Path or bytes
    what : str
        How error messages name the image.
    native : bool
        Keep 8- and 16-bit integers as they are.

    Raises
    ------
    InputError
        If it is missing or does not decode.
    """
    if isinstance(source, bytes):  # OpenImageIO's Python module reads files only
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / _guess_name(source, what)
            path.write_bytes(source)
            return _decode(path, what, native)
    if not source.is_file():
        raise InputError(f"{what}: no such file: {source}")
    return _decode(source, what, native)


def _decode(source: Path, what: str, native: bool) -> Image:
    import OpenImageIO as oiio

    try:
        fault = find_png_fault(source.read_bytes())
    except OSError as error:
        raise InputError(f"{what} cannot be read: {error.strerror}") from None
    if fault:
        raise InputError(f"{what} does not decode: {fault}: save it again")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(source), config)
    if reader is None:
        message = _reason(oiio.geterror(), source)
        raise InputError(f"{what} does not decode ({message}): save it as PNG, JPEG, TIFF or EXR")
    try:
        spec = reader.spec()
        stored = str(spec.format)
        kept = native and stored in ("uint8", "uint16")
        texels = reader.read_image(0, 0, 0, spec.nchannels, stored if kept else "float")
        if texels is None:
            raise InputError(f"{what} does not decode ({reader.geterror().splitlines()[0]}): it is damaged")
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
