"""Functions compiled to machine code. What is called from Python is compiled once per machine and kept: of an
installation in the user's cache, $XDG_CACHE_HOME/thermostand/machine-code or ~/.cache, since an installer removes only
what it has installed; of a clone next to the source, with which it goes. NUMBA_CACHE_DIR names another place."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import numba
from numba.core import config
from numba.extending import register_jitable

Function = TypeVar("Function", bound=Callable[..., Any])

_SETTINGS: Any = config  # its names are made when it is loaded
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
    return compile_with(**_OPTIONS)(function)


def compile_with(**options: Any) -> Callable[[Function], Function]:
    """Make the decorator that compiles a function with these options of numba's, and keeps it as `compile_entry`."""

    def decorate(function: Function) -> Function:
        try:
            with _choose_place(function):
                return cast(Function, numba.njit(cache=True, **options)(function))
        except RuntimeError:  # no locator available: nothing on this machine can be written to
            return cast(Function, numba.njit(**options)(function))

    return decorate


@contextmanager
def _choose_place(function: Callable[..., Any]) -> Generator[None]:
    """Inside, numba keeps the code of this function where it belongs: it chooses when a function is decorated."""
    given = _SETTINGS.CACHE_DIR
    if not given and {"site-packages", "dist-packages"} & set(Path(function.__code__.co_filename).parts):
        home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        _SETTINGS.CACHE_DIR = str(Path(home) / "thermostand" / "machine-code")
    try:
        yield
    finally:
        _SETTINGS.CACHE_DIR = given


def compute_digest(*modules: ModuleType) -> str:
    """A name for the sources of these modules."""
    sources = (Path(module.__file__ or "").read_bytes() for module in modules)
    return hashlib.sha256(b"".join(sources)).hexdigest()
