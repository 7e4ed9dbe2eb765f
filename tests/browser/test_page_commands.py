"""Commands on the page: each opens a dialog first, is sent once, and its response is shown."""

from __future__ import annotations

import pytest
from page_rig import DaemonProcess
from playwright.async_api import Page, expect

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]

DOUBLE_CLICK_MS = 150
DOUBLE_CLICK = """ms => new Promise(done => {
  document.querySelector("#do-guard").click();
  const again = () => document.querySelector("#dialog-confirm").dispatchEvent(new MouseEvent("click", {bubbles: true}));
  setTimeout(() => done(again()), ms);
})"""
"""Both clicks on the page's own clock, so that a busy machine does not delay the second."""
COLOURS = """(canvas) => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  return new Set(new Uint32Array(copy.getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
}"""


async def give(page: Page, name: str) -> None:
    """Press a button and confirm its dialog."""
    await page.click(f"#do-{name}")
    await expect(page.locator("#dialog-cancel")).to_be_focused()
    await page.click("#dialog-confirm")
    await expect(page.locator("#dialog")).to_be_hidden()


async def test_a_lift_from_calibration_to_release(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.fresh()
    page = await open_page()
    phase, figures = page.locator("#phase"), page.locator(".figures")
    await expect(phase).to_have_text("Idle")
    await expect(page.locator("#do-lift")).to_have_attribute("aria-disabled", "true")
    await expect(page.locator("#hint-lift")).to_have_text("only while holding")
    await give(page, "calibrate")
    await expect(page.locator("#message")).to_contain_text("background images")
    await give(page, "grasp")
    await expect(page.locator("#message")).to_have_text("closing with 40 N")
    await expect(phase).to_have_text("Holding")
    await expect(figures).to_contain_text("40 N")
    await expect(page.locator("#events")).to_contain_text("gripped")
    await give(page, "lift")
    await expect(phase).to_have_text("Lifting")
    await expect(figures).to_contain_text("40 mm")
    await expect(phase).to_have_text("Holding")
    running.until(lambda state: state["phase"] == "holding" and state["arm"]["height_mm"] > 39.0)
    for finger in ("left", "right"):
        await expect(page.locator(f"#finger-{finger}")).to_contain_text("contactyes", ignore_case=True)
        drawn = page.locator(f"#finger-{finger} canvas")
        assert await drawn.evaluate(COLOURS) > 1000, "a gel image has noise, and many colors"
        before = await drawn.get_attribute("data-sequence")
        await expect(drawn).not_to_have_attribute("data-sequence", str(before))
    await release(running, page)
    await expect(phase).to_have_text("Idle")
    await expect(page.locator("#events")).to_contain_text("released")


RELEASE_TEXT = "This opens the jaws, and never closes them: a held object drops. Support it first."


async def release(running: DaemonProcess, page: Page) -> None:
    """Neither a double click nor the Enter key opens the jaws: the box must be checked first."""
    await page.dblclick("#do-release")
    yes = page.locator("#dialog-confirm")
    await expect(page.locator("#dialog-text")).to_have_text(RELEASE_TEXT)
    await expect(page.locator("#dialog-cancel")).to_be_focused()
    await expect(page.locator("#dialog-state")).to_contain_text("check the box")
    await expect(yes).to_be_disabled()
    await page.locator("#dialog-checkbox").press("Enter")
    assert running.state()["phase"] == "holding"
    await page.check("#dialog-checkbox")
    await expect(yes).to_be_enabled()
    await page.uncheck("#dialog-checkbox")
    await expect(yes).to_be_disabled()
    await page.check("#dialog-checkbox")
    assert running.state()["phase"] == "holding"
    await yes.dblclick()
    await expect(page.locator("#dialog")).to_be_hidden()
    running.until(lambda state: state["phase"] == "idle")


async def test_a_double_click_gives_one_command(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held(again=False)
    page = await open_page()
    requested: list[str] = []
    page.on("request", lambda request: request.method == "POST" and requested.append(request.url))
    await page.evaluate(DOUBLE_CLICK, DOUBLE_CLICK_MS)
    await page.wait_for_timeout(100)
    assert not requested, "the second half of a double click must not say yes, wherever it falls"
    await expect(page.locator("#dialog-confirm")).to_be_enabled()
    await page.locator("#dialog-confirm").dblclick()
    await expect(page.locator("#do-guard .label")).to_have_text("Guard on")
    assert len(requested) == 1
    assert running.state()["guarding"] is False
    await expect(page.locator("#detail")).to_contain_text("NOT guarding")
    await give(page, "guard")
    await expect(page.locator("#do-guard .label")).to_have_text("Guard off")


async def test_a_refusal_is_shown_with_the_daemons_reason(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held()
    page = await open_page(expected=("status of 409",))
    await page.click("#do-lower")
    await page.fill("#field-height_mm", "9999")
    await page.click("#dialog-confirm")
    assert await page.locator("#field-height_mm").evaluate("one => one.validity.rangeOverflow")
    await page.click("#dialog-cancel")
    await page.click("#do-grasp", force=True)
    await expect(page.locator("#message")).to_have_text("Grasp is not possible: only when nothing is held")
    await page.click("#do-lower")
    await expect(page.locator("#dialog-confirm")).to_be_enabled()
    await page.click("#dialog-confirm")
    refused = page.locator("#dialog-error")
    await expect(refused).to_contain_text("give a height")
    await expect(page.locator("#dialog")).to_be_visible()
    await page.click("#dialog-cancel")
    await expect(page.locator("#message")).to_contain_text("give a height")
