// The fingers' pictures: fetched one after the other while somebody looks, and never an old one shown as new.

import { byId, make, setAttribute, setText } from "./dom.js";
import { deviceName, span, turnWords, withoutName } from "./format.js";

const ROUND_MS = 125; // both fingers, eight times a second
const PAUSE_MS = 1500; // after one that could not be had
const PATIENCE_MS = 3000;
const MISSES_MAX = 2;
const OLD_S = 0.5;

/** One finger: its picture, and what is said of it. */
class Finger {
  constructor(name) {
    this.name = name;
    this.sequence = null;
    this.notBefore = 0;
    this.misses = 0;
    this.gone = null; // why the sensor is not there, where that is known
    this.image = make("canvas", { width: 240, height: 320, role: "img" });
    this.missing = make("p", { className: "missing", textContent: "no picture yet" });
    this.stale = make("p", { className: "stale", hidden: true });
    this.title = make("b", { textContent: deviceName(name) });
    this.serial = make("span");
    this.caption = make("dl");
    this.figure = make(
      "figure", { id: `finger-${name}` },
      make("div", { className: "picture" }, this.image, this.missing, this.stale),
      make("figcaption", {}, make("p", { className: "name" }, this.title, " ", this.serial), this.caption),
    );
    this.values = {};
    for (const label of ["contact", "turn", "not told", "frames", "age"]) {
      const value = make("dd");
      this.caption.append(make("div", {}, make("dt", { textContent: label }), value));
      this.values[label] = value;
    }
    this.image.hidden = true;
  }

  /** Fetch the newest picture; false where there is none to be had now. */
  async fetch(overlay) {
    let answer;
    try {
      answer = await fetch(`/picture/${this.name}${overlay ? "" : "?overlay=0"}`, {
        cache: "no-store",
        signal: AbortSignal.timeout(PATIENCE_MS),
      });
      this.misses = 0;
      if (!answer.ok) {
        this.lack((await answer.json()).error);
        return false;
      }
      const shown = `${answer.headers.get("x-sequence")} ${overlay}`;
      const picture = await answer.blob();
      if (shown !== this.sequence) await this.put(picture);
      this.sequence = shown;
      this.image.dataset.sequence = shown;
      return true;
    } catch {
      this.misses += 1; // the last picture stays, greyed, if it is the connection that is gone
      if (this.misses > MISSES_MAX) this.lack("no picture comes");
      return false;
    }
  }

  /** Paint it once it is decoded: nothing flickers. */
  async put(picture) {
    const bitmap = await createImageBitmap(picture);
    this.image.getContext("2d").drawImage(bitmap, 0, 0, this.image.width, this.image.height);
    bitmap.close();
    this.image.hidden = false;
    this.missing.hidden = true;
  }

  lack(why) {
    this.sequence = null;
    this.image.hidden = true;
    this.stale.hidden = true;
    this.missing.hidden = false;
    setText(this.missing, why);
  }

  /** What the state says of this finger; health: of its device. */
  tell(finger, health, live) {
    this.gone = health.state === "disconnected" ? withoutName(this.name, health.reason) : null;
    if (this.gone) this.lack(this.gone);
    this.figure.classList.toggle("old", !live);
    setText(this.serial, finger.serial ?? "not seen yet");
    const estimate = finger.estimate;
    const turn = estimate ? turnWords(estimate.angle_deg, estimate.sigma_deg) : "not told";
    const contact = !estimate ? "not known" : estimate.contact ? "yes" : "no";
    const age_s = finger.age_s ?? null;
    const declined = live && estimate?.contact ? estimate.declined : null;
    const told = {
      contact,
      turn,
      "not told": declined ?? "",
      frames: `${Math.round(finger.frames_per_s ?? 0)} per s`,
      age: age_s === null ? "no frame" : ageWords(age_s),
    };
    for (const [label, value] of Object.entries(this.values)) setText(value, live && !this.gone ? told[label] : "–");
    this.values["not told"].parentElement.hidden = !declined;
    const old = !live || age_s === null || age_s > OLD_S;
    this.stale.hidden = !old || this.image.hidden;
    setText(this.stale, live ? `no new frame for ${span(age_s ?? 0)}` : "last picture, not live");
    const words = estimate?.contact ? `contact, turn ${turn}` : `contact: ${contact}`;
    setAttribute(this.image, "aria-label", `Gel picture of the ${deviceName(this.name)}, ${words}`);
  }
}

function ageWords(age_s) {
  return age_s < OLD_S ? `${(Math.round(age_s * 50) / 50).toFixed(2)} s` : span(age_s);
}

/** Both fingers; pictures come as long as the tab is seen and the connection is live. */
export class Pictures {
  constructor(isLive) {
    this.isLive = isLive;
    this.fingers = ["left", "right"].map((name) => new Finger(name));
    byId("fingers").append(...this.fingers.map((finger) => finger.figure));
    this.overlay = byId("overlay");
    this.follow();
  }

  /** For ever: one picture after the other, so that this page never asks for two at a time. */
  async follow() {
    for (;;) {
      const began = performance.now();
      for (const finger of this.fingers) {
        if (document.hidden || !this.isLive() || finger.gone || began < finger.notBefore) continue;
        if (!(await finger.fetch(this.overlay.checked))) finger.notBefore = performance.now() + PAUSE_MS;
      }
      if (document.hidden) await new Promise((seen) => document.addEventListener("visibilitychange", seen, { once: true }));
      else await new Promise((done) => setTimeout(done, Math.max(20, ROUND_MS - (performance.now() - began))));
    }
  }

  show(view) {
    if (!view.state) return;
    for (const finger of this.fingers) {
      const { fingers, devices } = view.state;
      finger.tell(fingers[finger.name], devices[finger.name], view.live);
    };
  }
}
