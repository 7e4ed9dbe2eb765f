// The operator page: shows the daemon's live stream. Values that are out of date are grayed and marked.

import { Commands } from "./commands.js";
import { Events, showDevices, showTiming } from "./details.js";
import { byId, setAttribute, setText } from "./dom.js";
import { armText, durationText, forces, headline, lastSlipText, plain, shares, signed, timeText } from "./format.js";
import { Graphs } from "./graphs.js";
import { History } from "./history.js";
import { FingerImages } from "./images.js";
import { Keys } from "./keys.js";
import { LiveStream } from "./live.js";
import { sessionHeaders } from "./session.js";
import { Stop } from "./stop.js";

const DETAILS_PERIOD_MS = 250; // figures that change faster cannot be read
const LONG_HEADLINE = 13; // characters; longer ones are set in smaller type
const ACCESS_EXPIRED = "Access has expired: slipguard or this browser was restarted. Log in again to send commands";
const HAD_CONTROL_KEY = "slipguard: this browser could command";

const view = { live: false, control: false, state: null };
let offlineSince = null;
let clockOffset_s = null;
let detailsAt = -Infinity;
let version = null;

const history = new History();
const events = new Events();
const graphs = new Graphs();
const commands = new Commands(fetchAccess);
const stop = new Stop(commands);
const images = new FingerImages(() => view.live);
new Keys(commands);

new LiveStream({
  opened() {
    events.clear(); // the daemon sends the newest events again
    history.marks = [];
    fetchAccess();
  },
  history(samples) {
    history.replace(samples);
    graphs.forceText();
  },
  state(state, sample) {
    if (version !== null && state.version !== version) location.reload(); // another version has another page
    version = state.version;
    view.state = state;
    view.live = true;
    offlineSince = null;
    if (sample.t_s !== null) {
      clockOffset_s = Date.now() / 1e3 - sample.t_s;
      history.add(sample);
    }
    show();
  },
  event(event) {
    history.mark(event.at_s, event.level);
    events.add(event, dateOf(event.at_s));
  },
  offline() {
    view.live = false;
    offlineSince = new Date();
    detailsAt = -Infinity;
    show();
  },
});
setInterval(showConnection, 500);
show();

/** Convert a time on the daemon's clock to a Date. */
function dateOf(at_s) {
  const offset_s = clockOffset_s ?? Date.now() / 1e3 - (history.now_s || at_s);
  return new Date(1e3 * (at_s + offset_s));
}

async function fetchAccess() {
  try {
    const response = await fetch("/access", {
      cache: "no-store",
      headers: sessionHeaders(),
      signal: AbortSignal.timeout(5000),
    });
    view.control = response.ok && (await response.json()).control === true;
  } catch {
    view.control = false;
  }
  if (view.control) storeHadControl();
  showAccess();
  commands.show(view);
}

function storeHadControl() {
  try {
    localStorage.setItem(HAD_CONTROL_KEY, "yes");
  } catch {
    // without storage, only the more precise text is lost
  }
}

function hadControl() {
  try {
    return localStorage.getItem(HAD_CONTROL_KEY) === "yes";
  } catch {
    return false;
  }
}

function show() {
  showConnection();
  showNow();
  commands.show(view);
  graphs.show(history, view);
  const now = performance.now();
  if (view.state && now - detailsAt >= DETAILS_PERIOD_MS) {
    detailsAt = now;
    images.show(view);
    showDevices(view.state, view.live);
    showTiming(view.state);
    setText(byId("version"), view.state.version);
  }
}

function showConnection() {
  const pill = byId("connection");
  document.body.classList.toggle("offline", !view.live);
  pill.classList.toggle("good", view.live);
  if (view.live) setText(pill, "live");
  else if (offlineSince) {
    setText(pill, `offline since ${timeText(offlineSince)} (${durationText((Date.now() - offlineSince) / 1e3)})`);
  } else setText(pill, "connecting …");
}

function showAccess() {
  const pill = byId("access");
  pill.hidden = false;
  setText(pill, view.control ? "commands enabled" : "read only");
  byId("login").hidden = view.control;
  stop.show(view.control);
  setText(byId("login-title"), hadControl() ? ACCESS_EXPIRED : "This page is read-only");
}

function showNow() {
  const state = view.state;
  if (!state) return;
  const summary = headline(state);
  setAttribute(byId("now"), "data-tone", view.live ? summary.tone : "offline");
  const word = view.live ? summary.word : "No connection";
  setText(byId("phase"), word);
  byId("phase").classList.toggle("long", word.length > LONG_HEADLINE);
  const lastKnown = `last known: ${summary.word}${summary.detail ? `, ${summary.detail}` : ""}`;
  setText(byId("detail"), view.live ? summary.detail : lastKnown);
  const lastSlip = view.live ? lastSlipText(state) : "";
  byId("last-slip").hidden = lastSlip === "";
  setText(byId("last-slip"), lastSlip && `Last slip ${lastSlip}`);
  document.title = `${word} – slipguard`;
  setText(byId("announcement"), word);
  showFault(view.live ? state.fault : null);
  showFigures(state);
}

function showFault(fault) {
  byId("fault").hidden = !fault;
  setText(byId("fault-code"), fault ? `Fault: ${fault.code}` : "");
  setText(byId("fault-observed"), fault ? `Observed: ${fault.observed}` : "");
  setText(byId("fault-do"), fault ? fault.what_to_do : "");
}

function showFigures(state) {
  const rotation = state.rotation;
  const estimated = view.live && rotation && rotation.rotation_deg !== null;
  setText(byId("rotation"), estimated ? `${signed(rotation.rotation_deg)}°` : "–");
  setText(byId("sigma"), estimated ? `± ${rotation.sigma_deg.toFixed(1)}°` : "");
  const { force_n, target_n, limit_n } = forces(state);
  setText(byId("force"), view.live && force_n !== null ? `${plain(force_n)} N` : "–");
  const target = target_n && Math.abs(target_n - force_n) >= 1 ? `target ${plain(target_n)}, ` : "";
  const known = view.live && state.gripper && limit_n !== null;
  setText(byId("force-limit"), known ? `${target}of ${plain(limit_n)} N` : "");
  const { force, rotation: rotated } = view.live ? shares(state) : { force: null, rotation: null };
  showShare("force-use", force);
  showShare("rotation-use", rotated);
  const arm = view.live ? state.arm : null;
  const lifted_mm = arm ? (state.lifted_mm ?? null) : null;
  const notLifted = arm ? "not lifted" : "–";
  setText(byId("height"), lifted_mm === null ? notLifted : `${plain(lifted_mm)} mm`);
  setText(byId("arm-motion"), arm ? armText(arm) : state.has_arm === false ? "none" : "");
}

function showShare(id, share) {
  const meter = byId(id);
  meter.hidden = share === null;
  if (share === null) return;
  meter.value = Math.min(share, 1);
  meter.title = `${plain(100 * share)} % of the limit`;
}
