"""The runtime under the project's name: `import seamskin` gives what `import runtime` gives, and `__version__`.

import seamskin
asset = seamskin.load("human.seamless")
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import runtime

if TYPE_CHECKING:
    from runtime import *  # noqa: F403

    __version__: str

__all__ = [*runtime.__all__, "__version__"]


def __getattr__(name: str) -> Any:
    """A name of the runtime, imported when it is first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        return version("seamskin")
    if name not in runtime.__all__:
        raise AttributeError(f"module 'seamskin' has no attribute {name!r}")
    return getattr(runtime, name)


def __dir__() -> list[str]:
    """All public names, imported yet or not: for completion."""
    return sorted({*globals(), *__all__})
