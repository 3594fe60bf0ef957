"""Tasks that run beside each other: awaited together, and none left behind."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Sequence
from typing import Any, TypeVar

Result = TypeVar("Result")


async def watched(work: Coroutine[None, None, Result], background: Sequence[asyncio.Task[None]]) -> Result:
    """What `work` returns; raises at once what a background task raises: without time or polls nothing would wake it.

    On any other way out than its own, `work` has ended before this returns.
    """
    task = asyncio.create_task(work)
    try:
        await _done(task, set(background))
        return await task
    finally:
        await cancelled([task])
        del task  # its exception's traceback holds this frame: a cycle that would keep every device alive for a while


async def _done(task: asyncio.Task[Any], pending: set[asyncio.Task[None]]) -> None:
    while not task.done():
        done, _ = await asyncio.wait({task, *pending}, return_when=asyncio.FIRST_COMPLETED)
        for finished in pending & done:
            pending.discard(finished)
            finished.result()


async def cancelled(tasks: Sequence[asyncio.Task[Any]]) -> None:
    """Cancel them and return when all have ended, whichever way."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
