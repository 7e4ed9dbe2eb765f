// The command buttons, and the dialog that each of them opens before anything moves.

import { byId, make, setAttribute, setText } from "./dom.js";
import { blockedReason } from "./permissions.js";
import { COMMANDS, send } from "./command_forms.js";
import { headline } from "./format.js";

const CONFIRM_DELAY_MS = 450; // so that the second half of a double click does not confirm

/** Buttons and dialog. onForbidden: called if the daemon no longer accepts commands from this browser. */
export class Commands {
  constructor(onForbidden) {
    this.onForbidden = onForbidden;
    this.view = { live: false, control: false, state: null };
    this.open = null; // {name, form} of the open dialog
    this.pending = null; // name of the command that was sent
    this.armed = false;
    this.armTimer = null;
    this.dialog = byId("dialog");
    this.confirmButton = byId("dialog-confirm");
    this.cancelButton = byId("dialog-cancel");
    this.buttons = Object.fromEntries(Object.keys(COMMANDS).map((name) => [name, this.makeButton(name)]));
    byId("buttons").append(...Object.values(this.buttons));
    byId("dialog-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.confirm();
    });
    byId("dialog-form").addEventListener("input", () => this.updateDialog());
    this.cancelButton.addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("mousedown", (event) => {
      // Without this, a click outside the buttons would take the focus from the cancel button.
      if (!event.target.closest("button, input, label")) event.preventDefault();
    });
    this.dialog.addEventListener("close", () => {
      if (!this.dialog.open) this.open = null; // the event is late: the next dialog may be open already
    });
  }

  makeButton(name) {
    const label = make("span", { className: "label", textContent: name });
    const hint = make("span", { className: "hint", id: `hint-${name}` });
    const button = make("button", { type: "button", id: `do-${name}` }, label, hint);
    button.classList.toggle("danger", Boolean(COMMANDS[name].danger));
    label.id = `label-${name}`;
    button.setAttribute("aria-labelledby", label.id);
    button.setAttribute("aria-describedby", hint.id);
    button.addEventListener("click", () => this.press(name));
    return button;
  }

  /** Show which commands are possible, and why others are not. */
  show(view) {
    this.view = view;
    for (const [name, button] of Object.entries(this.buttons)) {
      const [label, hint] = button.children;
      const form = view.state ? COMMANDS[name].form(view.state) : null;
      const sending = this.pending === name;
      const reason = sending ? "sending …" : view.state ? blockedReason(name, view) : "no connection";
      if (form) setText(label, form.label);
      setText(hint, reason ?? form.hint);
      setAttribute(button, "aria-disabled", reason === null ? null : "true");
      setAttribute(button, "aria-busy", sending ? "true" : null);
    }
    this.updateDialog();
  }

  press(name) {
    const reason = this.view.state ? blockedReason(name, this.view) : "no connection";
    if (this.pending) this.showMessage(`${this.pending}: waiting for the response`);
    else if (reason !== null) this.showMessage(`${this.buttons[name].children[0].textContent} is not possible: ${reason}`);
    else this.openDialog(name);
  }

  showMessage(text, bad = true) {
    const message = byId("message");
    setText(message, text);
    message.classList.toggle("bad", bad);
  }

  openDialog(name) {
    const form = COMMANDS[name].form(this.view.state);
    this.open = { name, form };
    setText(byId("dialog-title"), form.title);
    setText(byId("dialog-text"), form.text);
    setText(this.confirmButton, form.confirm);
    setText(this.cancelButton, form.cancel ?? "Cancel");
    setText(byId("dialog-error"), "");
    this.dialog.classList.toggle("danger", Boolean(COMMANDS[name].danger));
    byId("dialog-fields").replaceChildren(...makeFields(form));
    this.armed = false;
    clearTimeout(this.armTimer); // of a dialog that was closed before it was armed
    this.armTimer = setTimeout(() => {
      this.armed = true;
      this.updateDialog();
    }, CONFIRM_DELAY_MS);
    this.updateDialog();
    this.dialog.showModal();
    this.cancelButton.focus();
  }

  /** Update the open dialog to the present state. */
  updateDialog() {
    if (!this.open || !this.view.state) return;
    const { name, form } = this.open;
    const reason = blockedReason(name, this.view);
    const checkbox = byId("dialog-fields").querySelector("[type=checkbox]");
    const unchecked = form.checkbox?.required && !checkbox.checked;
    this.confirmButton.disabled = !this.armed || Boolean(reason) || unchecked || this.pending !== null;
    const now = this.view.live ? headline(this.view.state).word : "no connection";
    const waiting = this.pending ? "sending …" : unchecked ? "check the box to continue" : "";
    setText(byId("dialog-state"), [`Now: ${now}`, reason ?? waiting].filter(Boolean).join(" · "));
  }

  async confirm() {
    if (!this.open || this.confirmButton.disabled || this.pending) return;
    const { name, form } = this.open;
    if (!byId("dialog-form").reportValidity()) return;
    const body = { ...form.body, ...readFields(form) };
    this.pending = name;
    this.showMessage("");
    setText(byId("dialog-error"), "");
    this.show(this.view);
    const response = await send(name, form.path, body);
    this.pending = null;
    this.showMessage(response.text, !response.ok);
    if (response.forbidden) this.onForbidden();
    if (response.ok || this.open?.name !== name) {
      if (this.open?.name === name) this.dialog.close();
    } else {
      setText(byId("dialog-error"), response.text);
      this.cancelButton.focus();
    }
    this.show(this.view);
  }
}

function makeFields(form) {
  const made = (form.fields ?? []).map((field) => {
    const input = make("input", {
      type: "number", name: field.name, min: field.min, max: field.max, step: "any", inputMode: "decimal",
      value: field.initial ?? "", id: `field-${field.name}`,
    });
    const change = (by) => {
      const from = input.value === "" ? 0 : Number(input.value);
      input.value = Math.min(field.max, Math.max(field.min, from + by * field.step));
    };
    const less = make("button", { type: "button", textContent: "\u2212", ariaLabel: `${field.label}, less` });
    const more = make("button", { type: "button", textContent: "+", ariaLabel: `${field.label}, more` });
    less.addEventListener("click", () => change(-1));
    more.addEventListener("click", () => change(1));
    const label = make("label", { htmlFor: input.id, textContent: `${field.label}, ${field.unit}` });
    return make("div", { className: "field" }, label, make("div", { className: "stepper" }, less, input, more));
  });
  if (form.checkbox) {
    const checkbox = make("input", { type: "checkbox", id: "dialog-checkbox" });
    made.push(make("label", { className: "checkbox" }, checkbox, make("span", { textContent: form.checkbox.label })));
  }
  return made;
}

/** Return the entered values; an empty number is omitted, so that the daemon uses its default. */
function readFields(form) {
  const inputs = (form.fields ?? []).map((field) => byId(`field-${field.name}`));
  const numbers = inputs.filter((input) => input.value !== "").map((input) => [input.name, Number(input.value)]);
  const checked = form.checkbox?.body && byId("dialog-checkbox").checked ? form.checkbox.body : {};
  return { ...Object.fromEntries(numbers), ...checked };
}
