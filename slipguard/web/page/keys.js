// Keys for the commands. Each opens the same dialog as its button; the space bar stops at once (stop.js).

import { byId, make } from "./dom.js";

const COMMAND_KEYS = { g: "grasp", l: "lift", d: "lower", u: "guard", c: "clear", k: "calibrate", r: "release" };

/** commands: opens the dialogs. */
export class Keys {
  constructor(commands) {
    this.commands = commands;
    this.help = byId("keys");
    const rows = [["Space", "stop the arm at once; the grip stays"], ...Object.entries(COMMAND_KEYS), ["?", "this list"]];
    byId("key-list").append(
      ...rows.flatMap(([key, what]) => [make("dt", {}, make("kbd", { textContent: key })), make("dd", { textContent: what })]),
    );
    document.addEventListener("keydown", (event) => this.press(event));
  }

  press(event) {
    const types = event.target instanceof Element && event.target.closest("input, select, dialog[open]");
    if (types || event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === "?") this.help.showModal();
    else if (event.key in COMMAND_KEYS) this.commands.press(COMMAND_KEYS[event.key]);
    else return;
    event.preventDefault();
  }
}
