// The stop buttons and the space bar: the request is sent at once, without a dialog, also while another one is pending.

import { byId, setAttribute, setText } from "./dom.js";
import { send } from "./command_forms.js";

const HINT = "or the space bar: the arm stops, the grip stays";

/** commands: shows the response, and closes its dialog, which is about a state that is over. */
export class Stop {
  constructor(commands) {
    this.commands = commands;
    this.control = false;
    for (const button of document.querySelectorAll("button.stop")) {
      button.addEventListener("click", () => this.stop());
    }
    document.addEventListener("keydown", (event) => this.key(event));
    document.addEventListener("keyup", (event) => this.key(event)); // browsers differ in which of them presses a button
  }

  /** Show whether this browser may send commands. */
  show(control) {
    this.control = control;
    setText(byId("hint-stop"), control ? HINT : "read only");
    setAttribute(byId("do-stop"), "aria-disabled", control ? null : "true");
  }

  key(event) {
    const toggles = event.target instanceof Element && event.target.closest("[type=checkbox]");
    if (event.key !== " " || !this.control || toggles) return;
    event.preventDefault(); // neither scrolls nor presses the button that has the focus
    if (event.type === "keydown" && !event.repeat) this.stop();
  }

  async stop() {
    if (!this.control) {
      this.commands.showMessage("Stop is not possible: read only");
      return;
    }
    this.commands.dialog.close();
    this.commands.showMessage("stop: sending …", false);
    const response = await send("stop", "/stop", {});
    this.commands.showMessage(response.text, !response.ok);
    if (response.forbidden) this.commands.onForbidden();
  }
}
