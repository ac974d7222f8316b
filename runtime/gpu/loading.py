"""Loading while a game runs: reading and decoding in a thread, uploading a slice a frame.

``loading = Loading(ctx, "human.seamless")``, then once a frame ``loading.step()`` until it returns the model.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from runtime.asset.asset import load
from runtime.gpu.model import Model
from runtime.gpu.textures import Prepared, prepare

if TYPE_CHECKING:
    import moderngl

BUDGET_S = 0.002  # of a frame: an eighth of one at 60 a second


def _read(path: str | Path, position_format: str) -> Prepared:
    """Everything that needs no context; what a model imports late is imported here, not in a frame."""
    import_module("runtime.animation.mixer")
    return prepare(load(path), position_format)


class Loading:
    """A model on its way.

    Parameters
    ----------
    ctx : moderngl.Context
        The caller's; touched only inside `step`.
    path : str or Path
        A built character.
    position_format : str
        As for `Model`.
    """

    def __init__(self, ctx: moderngl.Context, path: str | Path, *, position_format: str = "auto") -> None:
        self._ctx = ctx
        self._model: Model | None = None
        self._done = False
        pool = ThreadPoolExecutor(1, thread_name_prefix="seamskin-load")
        self._reading: Future[Prepared] = pool.submit(_read, path, position_format)
        pool.shutdown(wait=False)

    def step(self, budget_s: float = BUDGET_S) -> Model | None:
        """Go on for about `budget_s` seconds. Call it in the context's thread, once a frame.

        Returns
        -------
        Model when all is there, None before

        Raises
        ------
        AssetError, RenderError
            As `runtime.load` and `Model` do; again at every further call.
        """
        if self._done:
            return self._model
        if not self._reading.done():
            return None
        end = time.perf_counter() + budget_s
        if self._model is None:
            self._model = Model(self._ctx, self._reading.result(), in_slices=True)
        while self._model.upload_slice():
            if time.perf_counter() >= end:
                return None
        self._done = True
        return self._model

    def release(self) -> None:
        """Give up, or free the model: may be called at any time and more than once."""
        self._reading.cancel()
        if self._model is not None:
            self._model.release()
