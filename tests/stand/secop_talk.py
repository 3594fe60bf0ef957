"""A SECoP client that says and reads lines."""

import asyncio
import json
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from typing import Any

LIMIT_S = 20.0


class Talk:
    """One client."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.updates: list[str] = []

    def say(self, *lines: str) -> None:
        self.writer.write("".join(f"{line}\n" for line in lines).encode())

    async def line(self) -> str:
        async with asyncio.timeout(LIMIT_S):
            return (await self.reader.readline()).decode().removesuffix("\n")

    async def ask(self, line: str) -> str:
        """The answer; updates that come before it are kept."""
        self.say(line)
        while "update " in (answer := await self.line()).replace("error_update", "update")[:7]:
            self.updates.append(answer)
        return answer

    async def asked(self, line: str) -> tuple[str, str, Any]:
        """The answer's action, specifier and content."""
        action, specifier, content = (await self.ask(line)).split(" ", 2)
        return action, specifier, json.loads(content)

    async def until(self, begin: str) -> str:
        """The first line that begins so."""
        while not (line := await self.line()).startswith(begin):
            assert line, "the connection has ended"
        return line

    async def end(self) -> bytes:
        """What came until the node hung up."""
        async with asyncio.timeout(LIMIT_S):
            with suppress(ConnectionError):
                return await self.reader.read()
        return b""


@asynccontextmanager
async def talking(port: int) -> AsyncGenerator[Talk]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 20)
    try:
        yield Talk(reader, writer)
    finally:
        writer.close()
        with suppress(ConnectionError):
            await writer.wait_closed()
