"""The page is accessible: contrast, sizes and names, in both themes, from phone to desktop, in every state."""

from __future__ import annotations

import re

import pytest
from page_layout import layout_problems, low_contrast_texts, unnamed_elements
from page_rig import DaemonProcess
from playwright.async_api import Page, expect

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]
WIDTHS = {"desk": (1280, 800), "phone": (390, 844), "narrow": (320, 640)}
THEMES = ("light", "dark")
SETTLED_MS = 150


async def check(page: Page, name: str) -> None:
    """Check contrast in both themes and layout at every width."""
    for kind, (width, height) in WIDTHS.items():
        await page.set_viewport_size({"width": width, "height": height})
        for theme in THEMES if kind == "desk" else THEMES[:1]:
            await page.emulate_media(color_scheme=theme, reduced_motion="reduce")
            await page.wait_for_timeout(SETTLED_MS)
            assert not await low_contrast_texts(page) + await layout_problems(page), f"{name}, {theme}, {kind}"
    assert not await unnamed_elements(page), name


async def test_layout_while_holding_in_a_dialog_and_in_a_fault(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held(again=False)
    page = await open_page()
    await expect(page.locator("#phase")).to_have_text("Holding")
    await check(page, "holding")
    await page.click("#do-release")
    await check(page, "asking")
    await page.keyboard.press("Escape")
    running.order("fail arm protective_stop")
    await expect(page.locator("#fault")).to_be_visible()
    await check(page, "fault")


async def test_layout_read_only_not_ready_and_offline(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.fresh()
    page = await open_page(control=False)
    running.order("fail left disconnect")
    await expect(page.locator("#phase")).to_have_text("Not ready")
    await check(page, "read-only-not-ready")
    with running.frozen():
        await expect(page.locator("#phase")).to_have_text("No connection")
        await check(page, "lost")


async def test_headings_landmarks_and_image_descriptions(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held(again=False)
    page = await open_page()
    headings = page.get_by_role("heading")
    assert await headings.all_text_contents() == [
        "slipguard", "Fingers", "Last minute", "Devices", "Timing", "Events",
    ]  # fmt: skip
    for region in ("State", "Commands", "Fingers", "Last minute", "Devices", "Timing", "Events"):
        await expect(page.get_by_role("region", name=region, exact=True)).to_have_count(1)
    await expect(page.get_by_role("main")).to_have_count(1)
    rotation = page.get_by_role("img", name="Rotation over the last minute")
    await expect(page.get_by_role("img", name="Grip force per finger over the last minute")).to_have_count(1)
    await expect(page.get_by_role("img", name="Gel image of the left finger, contact, rotation")).to_be_visible()
    await expect(page.get_by_role("button", name="Release")).to_have_accessible_description("opens: the object drops")
    await page.emulate_media(reduced_motion="reduce")
    await expect(page.locator("#do-release")).to_have_css("transition-duration", "0s")
    await expect(rotation).to_have_attribute("aria-label", re.compile("±"))
