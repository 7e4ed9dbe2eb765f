"""The contract suites run on the fakes, and on the real drivers against the doubles in `tests/wire`."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TypeVar

import pytest

sys.path.append(str(Path(__file__).parents[1] / "wire"))

T = TypeVar("T")
Eventually = Callable[[Callable[[], Awaitable[T]], Callable[[T], bool]], Awaitable[T]]


@pytest.fixture
def eventually() -> Eventually:
    """Ask until the answer is as it should be; fails with the last answer after three seconds."""

    async def ask(question: Callable[[], Awaitable[T]], good: Callable[[T], bool]) -> T:
        deadline_s = asyncio.get_running_loop().time() + 3.0
        while not good(answer := await question()):
            assert asyncio.get_running_loop().time() < deadline_s, f"still {answer}"
            await asyncio.sleep(0.01)
        return answer

    return ask
