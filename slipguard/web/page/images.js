// The images of both fingers: fetched one after the other while the page is visible. An old image is marked as old.

import { byId, make, setAttribute, setText } from "./dom.js";
import { deviceName, durationText, rotationText } from "./format.js";

const PERIOD_MS = 125; // both fingers, eight times per second
const RETRY_MS = 1500; // after a failed request
const TIMEOUT_MS = 3000;
const FAILURES_MAX = 2;
const OLD_S = 0.5;

/** One finger: its image, and the values shown below it. */
class FingerView {
  constructor(name) {
    this.name = name;
    this.shown = null;
    this.notBefore = 0;
    this.failures = 0;
    this.disconnected = null; // the reason, if the sensor is disconnected
    this.image = make("canvas", { width: 240, height: 320, role: "img" });
    this.missing = make("p", { className: "missing", textContent: "no image yet" });
    this.stale = make("p", { className: "stale", hidden: true });
    this.title = make("b", { textContent: deviceName(name) });
    this.serial = make("span");
    this.caption = make("dl");
    this.figure = make(
      "figure", { id: `finger-${name}` },
      make("div", { className: "image" }, this.image, this.missing, this.stale),
      make("figcaption", {}, make("p", { className: "name" }, this.title, " ", this.serial), this.caption),
    );
    this.values = {};
    for (const label of ["contact", "rotation", "no estimate", "frames", "age"]) {
      const value = make("dd");
      this.caption.append(make("div", {}, make("dt", { textContent: label }), value));
      this.values[label] = value;
    }
    this.image.hidden = true;
  }

  /** Fetch the newest image; return false if there is none. */
  async fetch(overlay) {
    try {
      const response = await fetch(`/image/${this.name}${overlay ? "" : "?overlay=0"}`, {
        cache: "no-store",
        signal: AbortSignal.timeout(TIMEOUT_MS),
      });
      this.failures = 0;
      if (!response.ok) {
        this.showMissing((await response.json()).error);
        return false;
      }
      const newest = `${response.headers.get("x-sequence")} ${overlay}`;
      const encoded = await response.blob();
      if (newest !== this.shown) await this.draw(encoded);
      this.shown = newest;
      this.image.dataset.sequence = newest;
      return true;
    } catch {
      this.failures += 1; // if only the connection is lost, the last image stays, marked as old
      if (this.failures > FAILURES_MAX) this.showMissing("no image received");
      return false;
    }
  }

  /** Draw the image after decoding it, so that it does not flicker. */
  async draw(encoded) {
    const bitmap = await createImageBitmap(encoded);
    this.image.getContext("2d").drawImage(bitmap, 0, 0, this.image.width, this.image.height);
    bitmap.close();
    this.image.hidden = false;
    this.missing.hidden = true;
  }

  showMissing(reason) {
    this.shown = null;
    this.image.hidden = true;
    this.stale.hidden = true;
    this.missing.hidden = false;
    setText(this.missing, reason);
  }

  /** Show the state of this finger; health: of its device. */
  showState(finger, health, live) {
    this.disconnected = health.state === "disconnected" ? health.reason : null;
    if (this.disconnected) this.showMissing(this.disconnected);
    this.figure.classList.toggle("outdated", !live);
    setText(this.serial, finger.serial ?? "not found yet");
    const estimate = finger.estimate;
    const rotation = estimate ? rotationText(estimate.rotation_deg, estimate.sigma_deg) : "no estimate";
    const contact = !estimate ? "not known" : estimate.contact ? "yes" : "no";
    const age_s = finger.age_s ?? null;
    const declined = live && estimate?.contact ? estimate.declined : null;
    const texts = {
      contact,
      rotation,
      "no estimate": declined ?? "",
      frames: `${Math.round(finger.frames_per_s ?? 0)} per s`,
      age: age_s === null ? "no frame" : ageText(age_s),
    };
    for (const [label, value] of Object.entries(this.values)) {
      setText(value, live && !this.disconnected ? texts[label] : "–");
    }
    this.values["no estimate"].parentElement.hidden = !declined;
    const old = !live || age_s === null || age_s > OLD_S;
    this.stale.hidden = !old || this.image.hidden;
    setText(this.stale, live ? `no new frame for ${durationText(age_s ?? 0)}` : "last image, not live");
    const description = estimate?.contact ? `contact, rotation ${rotation}` : `contact: ${contact}`;
    setAttribute(this.image, "aria-label", `Gel image of the ${deviceName(this.name)}, ${description}`);
  }
}

function ageText(age_s) {
  return age_s < OLD_S ? `${(Math.round(age_s * 50) / 50).toFixed(2)} s` : durationText(age_s);
}

/** Both fingers; images are fetched while the page is visible and the connection is live. */
export class FingerImages {
  constructor(isLive) {
    this.isLive = isLive;
    this.fingers = ["left", "right"].map((name) => new FingerView(name));
    byId("fingers").append(...this.fingers.map((finger) => finger.figure));
    this.overlay = byId("overlay");
    this.run();
  }

  /** Fetch one image after the other, never two at a time; does not return. */
  async run() {
    for (;;) {
      const began = performance.now();
      for (const finger of this.fingers) {
        if (document.hidden || !this.isLive() || finger.disconnected || began < finger.notBefore) continue;
        if (!(await finger.fetch(this.overlay.checked))) finger.notBefore = performance.now() + RETRY_MS;
      }
      if (document.hidden) await new Promise((shown) => document.addEventListener("visibilitychange", shown, { once: true }));
      else await new Promise((done) => setTimeout(done, Math.max(20, PERIOD_MS - (performance.now() - began))));
    }
  }

  show(view) {
    if (!view.state) return;
    const { fingers, devices } = view.state;
    for (const finger of this.fingers) finger.showState(fingers[finger.name], devices[finger.name], view.live);
  }
}
