"""Charts, events and explanations of the page show what they name."""

from __future__ import annotations

from typing import Any

import pytest
from page_rig import DaemonProcess
from playwright.async_api import expect

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]
SLIP_PIXELS = """async (kind) => {
  const { Chart } = await import("/page/chart.js");
  const canvas = document.createElement("canvas");
  canvas.style.cssText = "width: 400px; height: 200px; display: block";
  document.body.append(canvas);
  const plot = { now_s: 60, low: 0, high: 1, unit: "", live: true, shades: [], levels: [], bands: [], lines: [] };
  new Chart(canvas).draw({ ...plot, marks: [{ at_s: 30, kind, level: kind }] });
  await new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)));
  const pen = document.createElement("canvas").getContext("2d");
  pen.fillStyle = getComputedStyle(canvas).getPropertyValue("--slip-line");
  pen.fillRect(0, 0, 1, 1);
  const [red, green, blue] = pen.getImageData(0, 0, 1, 1).data;
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  canvas.remove();
  let count = 0;
  for (let at = 0; at < data.length; at += 4) {
    count += data[at] === red && data[at + 1] === green && data[at + 2] === blue && data[at + 3] === 255;
  }
  return count;
}"""
"""Number of pixels in the color of slip in a chart with one mark."""
LIST_EVENTS = """async (events) => {
  const { Events } = await import("/page/details.js");
  const list = new Events();
  events.forEach(([level, text, second]) => list.add({ level, text }, new Date(2026, 10, 22, 12, 0, second)));
  return [...document.querySelectorAll("#events li")].map((one) => one.textContent);
}"""


async def test_only_slip_is_drawn_as_slip(running: DaemonProcess, open_page: Any) -> None:
    page = await open_page(control=False)
    assert await page.evaluate(SLIP_PIXELS, "slip") > 100
    assert await page.evaluate(SLIP_PIXELS, "warning") == 0
    assert await page.evaluate(SLIP_PIXELS, "fault") == 0


async def test_each_kind_of_event_is_one_line_with_its_newest_time_and_a_count(
    running: DaemonProcess, open_page: Any
) -> None:
    page = await open_page(control=False)
    shown = await page.evaluate(
        LIST_EVENTS,
        [
            ("warning", "slip of 1.2 degrees", 1),
            ("info", "gripped with 40 N", 2),
            ("warning", "slip of 3.4 degrees", 3),
            ("info", "lifted", 4),
            ("warning", "slip of 5 degrees", 5),
        ],
    )
    assert shown == [
        "12:00:05warning slip of 5 degrees ×3 since 12:00:01", "12:00:04lifted", "12:00:02gripped with 40 N",
    ]  # fmt: skip


async def test_the_sign_of_the_right_finger_and_p99_are_explained(running: DaemonProcess, open_page: Any) -> None:
    page = await open_page(control=False)
    await expect(page.locator(".fingers")).to_contain_text("opposite sign")
    await expect(page.locator(".timing thead").first).to_contain_text("p99")
