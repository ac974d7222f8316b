"""What callers give, checked: numbers and names. Every refusal is one line that says what was given, and for what."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A clock that runs on by thirty years at once is none: it gave milliseconds, or the time of day.
LONGEST_S = 1e9
FASTEST = 1e6
MOST_NAMES = 12


def describe(value: object) -> str:
    """A value as it is told in a message: one short line."""
    return " ".join(repr(value).split())[:80]


def is_number(value: object) -> bool:
    """Whether it is one real number: no text, no truth value, no array of several."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool | complex | np.complexfloating)


def is_integer(value: object) -> bool:
    """Whether it is a whole number (NumPy's too) and no truth value."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    return isinstance(value, Integral) and not isinstance(value, bool)


def numbers(value: Any, what: str, largest: float = math.inf) -> NDArray[np.float64]:
    """Finite numbers of any shape, float64.

    Parameters
    ----------
    value : what the caller gave
    what : str
        What it is, for the message.
    largest : float
        Most that a number may be, either sign.

    Raises
    ------
    ValueError
    """
    try:
        array = np.asarray(value)
        fits = array.dtype.kind in "iufb" and bool((np.abs(array) <= largest).all()) and bool(np.isfinite(array).all())
    except (TypeError, ValueError):
        fits = False
    if not fits:
        bound = f" up to {largest:g}" if math.isfinite(largest) else ""
        raise ValueError(f"{what} must be finite numbers{bound}, not {describe(value)}")
    return array.astype(np.float64)


def step_s(dt_s: Any, who: str) -> float:
    """Time to run on by, seconds.

    Raises
    ------
    ValueError
        When it is no number, not finite, or longer than `LONGEST_S`.
    """
    try:
        if -LONGEST_S <= dt_s <= LONGEST_S:
            return float(dt_s)
    except (TypeError, ValueError):
        pass
    raise ValueError(f"{who} cannot be updated by {describe(dt_s)} seconds; check the frame clock")


def unknown_name(kind: str, name: object, names: Sequence[str], owner: str) -> ValueError:
    """An error for a name that is not there: what comes nearest, or what there is."""
    near: list[str] = []
    if isinstance(name, str):
        plain = {known.casefold(): known for known in reversed(names)}
        near = [plain[one] for one in difflib.get_close_matches(name.casefold(), list(plain), n=3, cutoff=0.5)]
        near += [known for known in names if name and name.casefold() in known.casefold() and known not in near]
    if near:
        return ValueError(f"no {kind} {describe(name)}; did you mean {' or '.join(repr(one) for one in near[:3])}?")
    listed = ", ".join(repr(known) for known in names[:MOST_NAMES]) or "none"
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ValueError(f"no {kind} {describe(name)}; the {owner} has {listed}{more}")
