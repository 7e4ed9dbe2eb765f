// Devices, timing and events: details for an engineer.

import { byId, make, setRows, setText } from "./dom.js";
import { armText, deviceName, gripperText, timeText } from "./format.js";

export const EVENTS_MAX = 50;
const COUNT_NAMES = {
  frames: "frames",
  corrupt: "damaged",
  torn: "torn",
  restarts: "restarts because of torn frames",
  frozen: "frozen",
  stalled: "stalled",
  missed: "missed by the camera",
  late: "too late",
};

const RETRY_NOTE = "slipguard keeps trying to connect. For more information run: slipguard doctor";

/** Show state, reason and advice of each device; without a connection, only that they are unknown. */
export function showDevices(state, live) {
  const rows = Object.entries(state.devices).map(([name, health]) => {
    if (!live) return [name, "not known", ""];
    const advice = health.state === "disconnected" ? [RETRY_NOTE] : [];
    const texts = [health.reason, ...advice, ...deviceTexts(state, name)].filter(Boolean);
    return [name, health.state, texts.join(". ")];
  });
  setRows(byId("devices"), rows, (name, health, reason) => {
    const item = make("li", {}, make("b", { textContent: deviceName(name) }), " ");
    item.append(make("span", { className: `health ${health}`, textContent: health }));
    if (reason) item.append(make("p", { textContent: reason }));
    return [item];
  });
}

/** Return what a connected device is doing or reports. */
function deviceTexts(state, name) {
  const finger = state.fingers[name];
  if (finger) {
    const gel = finger.gel && finger.gel.action ? [`gel ${finger.gel.status}: ${finger.gel.observed}; ${finger.gel.action}`] : [];
    return [finger.serial, ...finger.remarks, ...gel];
  }
  if (name === "gripper") return state.gripper ? [gripperText(state.gripper)] : [];
  if (state.has_arm === false) return ["none is configured"];
  return state.arm ? [armText(state.arm)] : [];
}

/** Show latencies, and the counts of each finger's frames. */
export function showTiming(state) {
  setRows(
    byId("latencies"),
    [
      ["frame to decision", ...milliseconds(state.latency)],
      ["gripper response", ...milliseconds(state.round_trips.gripper)],
      ["arm response", ...milliseconds(state.round_trips.arm)],
    ],
    tableRow,
  );
  const { left, right } = state.fingers;
  const countsOf = (finger) => ({ ...finger.counts, ...finger.counts.skipped, skipped: 0 });
  const counts = [countsOf(left), countsOf(right)];
  const names = [...new Set(counts.flatMap(Object.keys))];
  const shown = names.filter((name) => name === "frames" || counts.some((one) => one[name]));
  const rows = shown.map((name) => [COUNT_NAMES[name] ?? `skipped: ${name}`, ...counts.map((one) => String(one[name] ?? 0))]);
  setRows(byId("counts"), rows, tableRow);
  setText(byId("missed"), String(state.deadlines_missed));
}

function tableRow(name, ...cells) {
  const head = make("th", { scope: "row", textContent: name });
  return [make("tr", {}, head, ...cells.map((text) => make("td", { textContent: text })))];
}

function milliseconds(latency) {
  return latency ? [latency.p50_ms.toFixed(1), latency.p99_ms.toFixed(1)] : ["–", "–"];
}

/** The newest events, newest first: one line per kind of event, with its newest time and figures, and a count. */
export class Events {
  constructor() {
    this.list = byId("events");
    this.events = [];
    this.kind = byId("event-kind");
    this.kind.addEventListener("change", () => this.show());
  }

  /** Remove all events. */
  clear() {
    this.events = [];
    this.show();
  }

  /** Add an event; `at` is a Date. */
  add(event, at) {
    if (event.level === "fault") {
      this.events = this.events.filter((one) => one.text !== `${event.text}; ${event.what_to_do}`);
    }
    const kind = kindOf(event);
    const known = this.events.findIndex((one) => kindOf(one) === kind);
    const earlier = known < 0 ? { times: 0, since: at } : this.events.splice(known, 1)[0];
    this.events.unshift({ ...event, at, times: earlier.times + 1, since: earlier.since });
    this.events.length = Math.min(this.events.length, EVENTS_MAX);
    this.show();
  }

  show() {
    const shown = this.events.filter((event) => isOfKind(event, this.kind.value));
    byId("no-events").hidden = shown.length > 0;
    this.list.hidden = shown.length === 0;
    this.list.replaceChildren(
      ...shown.map((event) => {
        const item = make("li", { className: event.level });
        item.append(make("time", { textContent: timeText(event.at), dateTime: event.at.toISOString() }));
        const content = make("div", {});
        if (event.level !== "info") content.append(make("b", { className: "level", textContent: event.level }), " ");
        content.append(event.text);
        if (event.what_to_do) content.append(". ", make("span", { className: "do", textContent: event.what_to_do }));
        if (event.times > 1) content.append(" ", make("span", { className: "times", textContent: timesText(event) }));
        item.append(content);
        return item;
      }),
    );
  }
}

/** Return whether the filter shows an event; kind: "" for all, "trouble" for warnings and faults. */
function isOfKind(event, kind) {
  return kind === "" || event.kind === kind || (kind === "trouble" && event.level !== "info");
}

/** Return what two events of the same kind have in common: everything but the figures. */
function kindOf(event) {
  return `${event.level} ${event.text.replace(/\d+(\.\d+)?/g, "#")}`;
}

function timesText(event) {
  return `×${event.times} since ${timeText(event.since)}`;
}
