// The operator page: takes the daemon's live stream and shows it. What is old is greyed and said to be old.

import { Commands } from "./commands.js";
import { Events, showDevices, showPace } from "./details.js";
import { byId, setAttribute, setText } from "./dom.js";
import { Graphs } from "./graphs.js";
import { History } from "./history.js";
import { Live } from "./live.js";
import { Pictures } from "./images.js";
import { sessionHeaders } from "./session.js";
import { armWords, clock, forces, headline, plain, signed, span } from "./format.js";

const SLOW_MS = 250; // figures that change faster cannot be read
const SHORT = 13; // longer words of state are set in smaller type
const ENDED = "The login has ended with a restart of slipguard or of this browser: log in again to command";
const REMEMBERED = "slipguard: this browser could command";

const view = { live: false, control: false, state: null };
let lostAt = null;
let clockAhead_s = null;
let slowAt = -Infinity;
let version = null;

const history = new History();
const events = new Events();
const graphs = new Graphs();
const commands = new Commands(askAccess);
const pictures = new Pictures(() => view.live);

new Live({
  opened() {
    events.clear(); // the daemon tells the newest ones again
    history.marks = [];
    askAccess();
  },
  history(samples) {
    history.replace(samples);
    graphs.saidAt = -Infinity;
  },
  state(state, sample) {
    if (version !== null && state.version !== version) location.reload(); // another slipguard has another page
    version = state.version;
    view.state = state;
    view.live = true;
    lostAt = null;
    if (sample.t_s !== null) {
      clockAhead_s = Date.now() / 1e3 - sample.t_s;
      history.add({ ...sample, slipping: state.slipping });
    }
    show();
  },
  event(event) {
    history.mark(event.at_s, event.level);
    events.add(event, dateOf(event.at_s));
  },
  lost() {
    view.live = false;
    lostAt = new Date();
    slowAt = -Infinity;
    show();
  },
});
setInterval(showConnection, 500);
show();

/** The wall clock's time of a moment on the daemon's clock. */
function dateOf(at_s) {
  const offset_s = clockAhead_s ?? Date.now() / 1e3 - (history.now_s || at_s);
  return new Date(1e3 * (at_s + offset_s));
}

async function askAccess() {
  try {
    const answer = await fetch("/access", {
      cache: "no-store",
      headers: sessionHeaders(),
      signal: AbortSignal.timeout(5000),
    });
    view.control = answer.ok && (await answer.json()).control === true;
  } catch {
    view.control = false;
  }
  if (view.control) remember();
  showAccess();
  commands.show(view);
}

function remember() {
  try {
    localStorage.setItem(REMEMBERED, "yes");
  } catch {
    // a browser that stores nothing only loses the better words
  }
}

function remembers() {
  try {
    return localStorage.getItem(REMEMBERED) === "yes";
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
  if (view.state && now - slowAt >= SLOW_MS) {
    slowAt = now;
    pictures.show(view);
    showDevices(view.state, view.live);
    showPace(view.state);
    setText(byId("version"), view.state.version);
  }
}

function showConnection() {
  const pill = byId("connection");
  document.body.classList.toggle("lost", !view.live);
  pill.classList.toggle("good", view.live);
  if (view.live) setText(pill, "live");
  else if (lostAt) setText(pill, `lost since ${clock(lostAt)} (${span((Date.now() - lostAt) / 1e3)})`);
  else setText(pill, "connecting …");
}

function showAccess() {
  const pill = byId("access");
  pill.hidden = false;
  setText(pill, view.control ? "may command" : "read only");
  byId("login").hidden = view.control;
  setText(byId("login-title"), remembers() ? ENDED : "This page may look, not command");
}

function showNow() {
  const now = byId("now");
  const state = view.state;
  if (!state) return;
  const told = headline(state);
  setAttribute(now, "data-tone", view.live ? told.tone : "lost");
  const word = view.live ? told.word : "No connection";
  setText(byId("phase"), word);
  byId("phase").classList.toggle("long", word.length > SHORT);
  setText(byId("detail"), view.live ? told.detail : `last known: ${told.word}${told.detail ? `, ${told.detail}` : ""}`);
  document.title = `${word} – slipguard`;
  setText(byId("spoken"), word);
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
  const turn = state.rotation;
  const told = view.live && turn && turn.rotation_deg !== null;
  setText(byId("turn"), told ? `${signed(turn.rotation_deg)}°` : "–");
  setText(byId("sigma"), told ? `± ${turn.sigma_deg.toFixed(1)}°` : "");
  const { force_n, target_n, budget_n } = forces(state);
  const gripped = view.live && force_n !== null;
  setText(byId("force"), gripped ? `${plain(force_n)} N` : "–");
  const asked = target_n && Math.abs(target_n - force_n) >= 1 ? `asked for ${plain(target_n)}, ` : "";
  setText(byId("budget"), gripped && budget_n !== null ? `${asked}of ${plain(budget_n)} N` : "");
  const arm = view.live ? state.arm : null;
  setText(byId("height"), arm ? `${plain(arm.height_mm)} mm` : "–");
  setText(byId("arm-moves"), arm ? armWords(arm) : "");
}
