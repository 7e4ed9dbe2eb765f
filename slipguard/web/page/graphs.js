// The two charts of the page: what is plotted, and the same in words for those who do not see it.

import { Chart } from "./chart.js";
import { byId, setAttribute, setText } from "./dom.js";
import { SPAN_S, summary } from "./history.js";
import { forces, plain, turnWords } from "./format.js";

const WORDS_EVERY_MS = 5000;
const TURN_ROOM_DEG = 4;

/** Draws the minute; call `show` whenever there is news. */
export class Graphs {
  constructor() {
    this.turn = new Chart(byId("turn-chart"));
    this.force = new Chart(byId("force-chart"));
    this.saidAt = -Infinity;
  }

  show(history, view) {
    const samples = history.samples.filter((one) => one.t_s >= history.now_s - SPAN_S);
    const common = {
      now_s: history.now_s,
      live: view.live,
      shades: [
        ...shades(history.stretches((one) => one.phase === "fault"), "--fault-shade"),
        ...shades(history.stretches((one) => one.slipping), "--slip-shade"),
      ],
      marks: history.marks.filter((mark) => mark.level !== "info"),
    };
    this.turn.draw({ ...common, ...turnPlot(samples) });
    const budget_n = view.state ? forces(view.state).budget_n : null;
    this.force.draw({ ...common, ...forcePlot(samples, budget_n) });
    this.say(samples, view);
  }

  say(samples, view) {
    const now = performance.now();
    if (view.live && now - this.saidAt < WORDS_EVERY_MS) return;
    this.saidAt = now;
    const state = view.state;
    const last = samples.at(-1);
    const newest = view.live ? "now" : "last known";
    const turn = last ? turnWords(last.rotation_deg, last.sigma_deg) : "not told";
    const turnRange = summary(samples, "rotation_deg", "°", true);
    const { force_n, budget_n } = state ? forces(state) : { force_n: null, budget_n: null };
    const force = force_n === null ? "not known" : `${plain(force_n)} N of ${plain(budget_n ?? 0)} N`;
    const forceRange = summary(samples, "force_n", " N", false);
    setText(byId("turn-text"), turnRange ?? "not told in the last minute");
    setText(byId("force-text"), forceRange ?? "not known in the last minute");
    setAttribute(
      this.turn.canvas, "aria-label", `Turn over the last minute: ${turnRange ?? "not told"}; ${newest} ${turn}`,
    );
    setAttribute(
      this.force.canvas, "aria-label",
      `Grip per finger over the last minute: ${forceRange ?? "not known"}; ${newest} ${force}`,
    );
  }
}

function shades(stretches, colour) {
  return stretches.map(([from_s, to_s]) => ({ from_s, to_s, colour }));
}

function turnPlot(samples) {
  const told = samples.filter((one) => one.rotation_deg !== null);
  const reach = told.flatMap((one) => [one.rotation_deg - one.sigma_deg, one.rotation_deg + one.sigma_deg]);
  return {
    unit: "°",
    low: Math.min(-TURN_ROOM_DEG, ...reach.map((value) => value - 1)),
    high: Math.max(TURN_ROOM_DEG, ...reach.map((value) => value + 1)),
    levels: [],
    bands: [
      {
        colour: "--turn-band",
        points: samples.map((one) =>
          one.rotation_deg === null
            ? [one.t_s, null, null]
            : [one.t_s, one.rotation_deg - one.sigma_deg, one.rotation_deg + one.sigma_deg],
        ),
      },
    ],
    lines: [{ colour: "--turn-line", points: samples.map((one) => [one.t_s, one.rotation_deg]) }],
  };
}

function forcePlot(samples, budget_n) {
  const known = samples.flatMap((one) => [one.force_n ?? 0, one.target_n ?? 0]);
  return {
    unit: " N",
    low: 0,
    high: 1.1 * Math.max(20, budget_n ?? 0, ...known),
    levels: budget_n === null ? [] : [{ value: budget_n, colour: "--budget-line" }],
    bands: [],
    lines: [
      { colour: "--force-line", points: samples.map((one) => [one.t_s, one.force_n]) },
      { colour: "--target-line", dash: [6, 4], points: samples.map((one) => [one.t_s, one.target_n || null]) },
    ],
  };
}
