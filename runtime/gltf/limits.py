"""The ranges of numbers and amounts that the pipeline can carry: stated here, checked at the door, no further in.

A file may say more than any character needs: rotations of 1e300, key times in the year 1e30, five kilobytes that ask
for gigabytes. Each limit is far beyond what characters have and well within what 64-bit sums of fourth powers, 32-bit
textures and a laptop's memory take. Each is an option (`--limit NAME=VALUE`).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """The most that a file may say or ask for.

    Attributes
    ----------
    number : float
        Of coordinates, matrices, factors and key values, either sign: 10⁹ metres, where 32 bits are no finer than a
        character.
    whole : int
        Of indices, counts and sizes in a file's text.
    uv : float
        Of texture coordinates, either sign: beyond it, 32 bits hold no hundredth of a picture.
    time_s : float
        Of a clip's key times: eleven days.
    reach : float
        How far a clip may move a part, times the character's size: beyond, 32 bits are no finer than a tenth of it.
    file_bytes : int
        Of a file, asked before it is read.
    unbacked_bytes : int
        Of all accessors without data together: they ask for memory that the file does not hold.
    reuse : int
        Decoded bytes for each byte that the file holds: accessors may overlap.
    triangles : int
        Of a file's scene, instances counted one by one.
    joints : int
        Of a file's skins and rigid parts together.
    image_texels : int
        Of all images of a file together.
    """

    number: float = 1e9
    whole: int = 2**48
    uv: float = 2.0**16
    time_s: float = 1e6
    reach: float = 2.0**20
    file_bytes: int = 2**32
    unbacked_bytes: int = 2**25
    reuse: int = 16
    triangles: int = 2**23
    joints: int = 2**14
    image_texels: int = 2**28


LIMITS = Limits()
