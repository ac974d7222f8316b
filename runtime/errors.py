"""The exceptions of the runtime: a file is at fault, or something that was asked for cannot be drawn."""

from __future__ import annotations

from typing import Any, NoReturn

REBUILD = "build the character again with python -m preprocess"  # what to do about a folder that is wrong


MOST_LETTERS = 290  # of a refusal: names and values from hostile files may be of any length


def one_line(message: object) -> str:
    """A message as one line of at most `MOST_LETTERS` letters: its middle is left out where it is longer."""
    text = " ".join(str(message).split())
    if len(text) <= MOST_LETTERS:
        return text
    tail = MOST_LETTERS // 3
    return f"{text[: MOST_LETTERS - tail - 3]} … {text[-tail:]}"


class AssetError(Exception):
    """A file that cannot be used.

    The message is one line: what is wrong, where (file, accessor, texture), what to do.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class RenderError(Exception):
    """Something that cannot be drawn: a context too old or released, an object already released, a bad pose.

    The message is one line (a shader's compile log follows it): what is wrong, with what, what to do.
    """


class NotCopied:
    """What lives in an OpenGL context: two copies would free each other's buffers, and a file cannot hold it."""

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Refuse `copy.copy`, `copy.deepcopy` and `pickle`.

        Raises
        ------
        RenderError
        """
        kind = type(self).__name__
        raise RenderError(f"a {kind} lives in its OpenGL context and cannot be copied or pickled: make another")
