"""Tasks that run concurrently: awaited together, and none left behind."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Sequence
from typing import Any, TypeVar

Result = TypeVar("Result")


async def run_with_background(work: Coroutine[None, None, Result], background: Sequence[asyncio.Task[None]]) -> Result:
    """Return what `work` returns; raises at once what a background task raises: without time or polls nothing would
    wake it.

    On any other way out than its own, `work` has ended before this returns.
    """
    task = asyncio.create_task(work)
    try:
        await _wait_until_done(task, set(background))
        return await task
    finally:
        await cancel_all([task])
        del task  # its exception's traceback holds this frame: a cycle that would keep every device alive for a while


async def _wait_until_done(task: asyncio.Task[Any], pending: set[asyncio.Task[None]]) -> None:
    while not task.done():
        done, _ = await asyncio.wait({task, *pending}, return_when=asyncio.FIRST_COMPLETED)
        for finished in pending & done:
            pending.discard(finished)
            finished.result()


async def cancel_all(tasks: Sequence[asyncio.Task[Any]]) -> None:
    """Cancel them and return when all have ended, whichever way."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def wait_for_first(*waits: Coroutine[Any, Any, object]) -> int:
    """Wait until the first of these is over and return its place among them; the others are cancelled. What it raised
    is not raised here."""
    tasks = [asyncio.ensure_future(wait) for wait in waits]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return next(place for place, task in enumerate(tasks) if task in done)
    finally:
        for task in tasks:
            task.cancel()


def find_cause(error: BaseException) -> BaseException:
    """Return what has really gone wrong: of a group of errors the first, but a lack of memory before all others."""
    if not isinstance(error, BaseExceptionGroup):
        return error
    leaves = [find_cause(each) for each in error.exceptions]
    return next((leaf for leaf in leaves if isinstance(leaf, MemoryError)), leaves[0])


def describe_failure(error: BaseException) -> str:
    """The error as words for an operator."""
    if isinstance(error, MemoryError):
        return "out of memory"
    return str(error) or type(error).__name__
