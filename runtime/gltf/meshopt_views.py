"""Buffer views compressed with meshoptimizer (EXT_meshopt_compression, KHR_meshopt_compression).

Decoded by the package meshopt. Sources: the extensions' specifications (Khronos Group).
"""

from __future__ import annotations

from typing import Any

from runtime.errors import AssetError

INSTALL = "install what decodes it with `pip install meshopt`, or decompress it with `gltf-transform copy`"
MODES = ("ATTRIBUTES", "TRIANGLES", "INDICES")
FILTERS = ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR")
# Of zeros alone 256 bytes take a quarter of a byte: what asks for more bytes than that is no stream of theirs.
MOST_RATIO = 1024
LARGEST_STRIDE = 256


def decode_view(spec: dict[str, Any], data: bytes, most_bytes: int, where: str) -> bytes:
    """The plain bytes of a compressed view.

    Parameters
    ----------
    spec : dict
        The extension's object.
    data : bytes
        What it points to.
    most_bytes : int
        That may be asked for.
    where : str
        How messages name the view.

    Raises
    ------
    AssetError
        If the decoder is not installed, or the stream or its description is damaged.
    """
    count, stride, mode, kind = (spec.get(key) for key in ("count", "byteStride", "mode", "filter"))
    if not (isinstance(count, int) and isinstance(stride, int) and count > 0 and 0 < stride <= LARGEST_STRIDE):
        raise AssetError(f"{where}: the count or byteStride of its compressed data is malformed: export again")
    if mode not in MODES or kind not in (None, *FILTERS):
        raise AssetError(f"{where}: the mode or filter of its compressed data is unknown: export again")
    if count * stride > min(MOST_RATIO * len(data), most_bytes):
        raise AssetError(f"{where}: {len(data)} compressed bytes cannot be {count} × {stride}: the file is damaged")
    try:
        import meshopt
    except ImportError:
        raise AssetError(f"{where} is compressed with meshopt: {INSTALL}") from None
    try:
        decoded = meshopt.decode_gltf_buffer(data, count, stride, mode, kind)
    except (ValueError, TypeError, RuntimeError) as error:
        raise AssetError(f"{where}: its compressed data is damaged ({str(error)[:60]}): export again") from None
    if decoded.nbytes != count * stride:
        raise AssetError(f"{where}: its compressed data has {decoded.nbytes} bytes, not {count} × {stride}")
    return bytes(decoded.tobytes())
