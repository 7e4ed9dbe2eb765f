"""The space bar on the page ends a lift on the emulated cell within 60 ms, counted from the key."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
from playwright.async_api import Browser, expect

sys.path.append(str(Path(__file__).parents[1] / "wire"))

from stop_rig import WITHIN_S, stop_rig
from ur_scene import own_address

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]
TIMES = 5


@pytest.mark.campaign
@pytest.mark.realtime
async def test_the_space_bar_ends_a_lift_within_60_ms(browser: Browser, tmp_path: Path) -> None:
    took_s = []
    with stop_rig(tmp_path, own_address(69)) as rig:
        context = await browser.new_context()
        page = await context.new_page()
        await page.goto(rig.client.page_link()["url"])
        await page.locator("#access", has_text="may command").wait_for()
        for _ in range(TIMES):
            rig.lift()
            await expect(page.locator("#phase")).to_have_text("Lifting")
            pressed_s = time.monotonic()
            await page.keyboard.press("Space")
            await expect(page.locator("#message")).to_contain_text("stopped by request")
            took_s.append(rig.rested_s() - pressed_s)
            rig.lower()
        await context.close()
    print([round(1000.0 * one) for one in took_s], "ms")
    assert max(took_s) <= WITHIN_S, took_s
