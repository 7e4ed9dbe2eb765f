// Devices, pace and events: what an engineer looks at after the first glance.

import { byId, make, setRows, setText } from "./dom.js";
import { armWords, clock, deviceName, gripperWords, withoutName } from "./format.js";

export const EVENTS_KEPT = 50;
const COUNTED = {
  frames: "frames",
  corrupt: "damaged",
  frozen: "frozen",
  stalled: "stalled",
  missed: "missed by the camera",
  late: "too late",
};

const REPEATED_MS = 20000;
const REMARK = /^(left|right|gripper|arm)( finger)?: /;
const RETRIED = "It is tried again by itself. More is said by: slipguard doctor";

/** Each device in a line: how it is, why, and what to do; nothing of the past where the connection is lost. */
export function showDevices(state, live) {
  const rows = Object.entries(state.devices).map(([name, health]) => {
    if (!live) return [name, "not known", ""];
    const help = health.state === "disconnected" ? [RETRIED] : [];
    const words = [withoutName(name, health.reason), ...help, ...does(state, name)].filter(Boolean);
    return [name, health.state, words.join(". ")];
  });
  setRows(byId("devices"), rows, (name, health, why) => {
    const item = make("li", {}, make("b", { textContent: deviceName(name) }), " ");
    item.append(make("span", { className: `health ${health}`, textContent: health }));
    if (why) item.append(make("p", { textContent: why }));
    return [item];
  });
}

/** What a device that is there does or remarks. */
function does(state, name) {
  const finger = state.fingers[name];
  if (finger) {
    const gel = finger.gel && finger.gel.action ? [`gel ${finger.gel.status}: ${finger.gel.observed}; ${finger.gel.action}`] : [];
    return [finger.serial, ...finger.remarks, ...gel];
  }
  if (name === "gripper") return state.gripper ? [gripperWords(state.gripper)] : [];
  return state.arm ? [armWords(state.arm)] : [];
}

/** How fast everything is, and what was left out of each finger's frames. */
export function showPace(state) {
  setRows(
    byId("times"),
    [
      ["frame to decision", ...milliseconds(state.latency)],
      ["gripper's answer", ...milliseconds(state.round_trips.gripper)],
      ["arm's answer", ...milliseconds(state.round_trips.arm)],
    ],
    tableRow,
  );
  const { left, right } = state.fingers;
  const kinds = (finger) => ({ ...finger.counts, ...finger.counts.skipped, skipped: 0 });
  const counts = [kinds(left), kinds(right)];
  const names = [...new Set(counts.flatMap(Object.keys))];
  const told = names.filter((name) => name === "frames" || counts.some((one) => one[name]));
  const rows = told.map((name) => [COUNTED[name] ?? `skipped: ${name}`, ...counts.map((one) => String(one[name] ?? 0))]);
  setRows(byId("counts"), rows, tableRow);
  setText(byId("missed"), String(state.deadlines_missed));
}

function tableRow(what, ...cells) {
  const head = make("th", { scope: "row", textContent: what });
  return [make("tr", {}, head, ...cells.map((text) => make("td", { textContent: text })))];
}

function milliseconds(trips) {
  return trips ? [trips.p50_ms.toFixed(1), trips.p99_ms.toFixed(1)] : ["–", "–"];
}

/** The newest events, newest first; what comes again and again is told once, with its newest figures, and counted. */
export class Events {
  constructor() {
    this.list = byId("events");
    this.kept = [];
  }

  /** Forget all. */
  clear() {
    this.kept = [];
    this.show();
  }

  /** One more; `at` is a Date. */
  add(event, at) {
    if (event.level === "fault") this.kept = this.kept.filter((one) => one.text !== `${event.text}; ${event.what_to_do}`);
    const again = this.kept.findIndex((one, index) => tellsAgain(event, one, index, at));
    const times = again < 0 ? 1 : this.kept.splice(again, 1)[0].times + 1;
    this.kept.unshift({ ...event, at, times });
    this.kept.length = Math.min(this.kept.length, EVENTS_KEPT);
    this.show();
  }

  show() {
    byId("no-events").hidden = this.kept.length > 0;
    this.list.hidden = this.kept.length === 0;
    this.list.replaceChildren(
      ...this.kept.map((event) => {
        const text = event.times > 1 ? `${event.text} (×${event.times})` : event.text;
        const item = make("li", { className: event.level });
        item.append(make("time", { textContent: clock(event.at), dateTime: event.at.toISOString() }));
        const words = make("div", {});
        if (event.level !== "info") words.append(make("b", { className: "level", textContent: event.level }), " ");
        words.append(text);
        if (event.what_to_do) words.append(make("p", { className: "do", textContent: event.what_to_do }));
        item.append(words);
        return item;
      }),
    );
  }
}

/** Whether an event only tells one of the newest again: the last one, or a device's remark, whatever its figures. */
function tellsAgain(event, one, index, at) {
  if (event.level === "fault" || event.level !== one.level) return false;
  if (!REMARK.test(event.text)) return index === 0 && event.text === one.text;
  const words = (text) => text.replace(/[\d.]+/g, "#");
  return at - one.at < REPEATED_MS && words(event.text) === words(one.text);
}
