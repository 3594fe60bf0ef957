"""Functions compiled to machine code. What is called from Python is compiled once per machine and kept next to the
source, or in the user's cache where the installation is read-only (numba's own rule; NUMBA_CACHE_DIR names another
place)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import numba
from numba.extending import register_jitable

Function = TypeVar("Function", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},
    "no_cfunc_wrapper": True,
}
"""Sums may be taken in the order that suits the processor, the same each time. NaN and infinity keep their meaning."""


def compile_part(function: Function) -> Function:
    """A part of an `entry`, compiled into it; called from Python it is the plain function.

    Write loops over scalars: numpy's functions, sums of arrays and copies into slices take long to compile, with all
    that they are made of, down to their error messages.
    """
    return register_jitable(**_OPTIONS)(function)


def compile_entry(function: Function) -> Function:
    """The function as machine code that releases the GIL, compiled when first called and then kept; in every process
    when there is no place to keep it.

    Kept code is thrown away when the function's own file changes, or a variable of the function around it: `digest` of
    the modules that are compiled into it belongs there.
    """
    try:
        return cast(Function, numba.njit(cache=True, **_OPTIONS)(function))
    except RuntimeError:  # no locator available: nothing on this machine can be written to
        return cast(Function, numba.njit(**_OPTIONS)(function))


def compute_digest(*modules: ModuleType) -> str:
    """A name for the sources of these modules."""
    sources = (Path(module.__file__ or "").read_bytes() for module in modules)
    return hashlib.sha256(b"".join(sources)).hexdigest()
