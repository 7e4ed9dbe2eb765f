// The two charts of the page, and their text for screen readers.

import { Chart } from "./chart.js";
import { byId, setAttribute, setText } from "./dom.js";
import { SPAN_S, summary } from "./history.js";
import { forces, plain, rotationText } from "./format.js";

const TEXT_PERIOD_MS = 5000;
const MIN_RANGE_DEG = 4;

/** Draws the last minute; call `show` after each change. */
export class Graphs {
  constructor() {
    this.rotation = new Chart(byId("rotation-chart"));
    this.force = new Chart(byId("force-chart"));
    this.textAt = -Infinity;
  }

  show(history, view) {
    const samples = history.samples.filter((one) => one.t_s >= history.now_s - SPAN_S);
    const slips = history.stretches((one) => one.slipping);
    const common = {
      now_s: history.now_s,
      live: view.live,
      shades: [
        ...shades(history.stretches((one) => one.phase === "fault"), "--fault-shade"),
        ...shades(slips, "--slip-shade"),
      ],
      marks: [...history.marks, ...slips.map(([at_s]) => ({ at_s, kind: "slip" }))],
    };
    this.rotation.draw({ ...common, ...rotationPlot(samples) });
    const limit_n = view.state ? forces(view.state).limit_n : null;
    this.force.draw({ ...common, ...forcePlot(samples, limit_n) });
    this.updateText(samples, view);
  }

  /** Update the text at the next `show`. */
  forceText() {
    this.textAt = -Infinity;
  }

  updateText(samples, view) {
    const now = performance.now();
    if (view.live && now - this.textAt < TEXT_PERIOD_MS) return;
    this.textAt = now;
    const state = view.state;
    const last = samples.at(-1);
    const newest = view.live ? "now" : "last known";
    const rotation = last ? rotationText(last.rotation_deg, last.sigma_deg) : "no estimate";
    const rotationRange = summary(samples, "rotation_deg", "°", true);
    const { force_n, limit_n } = state ? forces(state) : { force_n: null, limit_n: null };
    const force = force_n === null ? "not known" : `${plain(force_n)} N of ${plain(limit_n ?? 0)} N`;
    const forceRange = summary(samples, "force_n", " N", false);
    setText(byId("rotation-range"), rotationRange ?? "no estimate in the last minute");
    setText(byId("force-range"), forceRange ?? "not known in the last minute");
    setAttribute(
      this.rotation.canvas, "aria-label",
      `Rotation over the last minute: ${rotationRange ?? "no estimate"}; ${newest} ${rotation}`,
    );
    setAttribute(
      this.force.canvas, "aria-label",
      `Grip force per finger over the last minute: ${forceRange ?? "not known"}; ${newest} ${force}`,
    );
  }
}

function shades(stretches, color) {
  return stretches.map(([from_s, to_s]) => ({ from_s, to_s, color }));
}

function rotationPlot(samples) {
  const estimated = samples.filter((one) => one.rotation_deg !== null);
  const bounds = estimated.flatMap((one) => [one.rotation_deg - one.sigma_deg, one.rotation_deg + one.sigma_deg]);
  return {
    unit: "°",
    low: Math.min(-MIN_RANGE_DEG, ...bounds.map((value) => value - 1)),
    high: Math.max(MIN_RANGE_DEG, ...bounds.map((value) => value + 1)),
    levels: [],
    bands: [
      {
        color: "--rotation-band",
        points: samples.map((one) =>
          one.rotation_deg === null
            ? [one.t_s, null, null]
            : [one.t_s, one.rotation_deg - one.sigma_deg, one.rotation_deg + one.sigma_deg],
        ),
      },
    ],
    lines: [{ color: "--rotation-line", points: samples.map((one) => [one.t_s, one.rotation_deg]) }],
  };
}

function forcePlot(samples, limit_n) {
  const known = samples.flatMap((one) => [one.force_n ?? 0, one.target_n ?? 0]);
  return {
    unit: " N",
    low: 0,
    high: 1.1 * Math.max(20, limit_n ?? 0, ...known),
    levels: limit_n === null ? [] : [{ value: limit_n, color: "--limit-line" }],
    bands: [],
    lines: [
      { color: "--force-line", points: samples.map((one) => [one.t_s, one.force_n]) },
      { color: "--target-line", dash: [6, 4], points: samples.map((one) => [one.t_s, one.target_n || null]) },
    ],
  };
}
