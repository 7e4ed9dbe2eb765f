// The buttons, and the question each of them asks before anything moves.

import { byId, make, setAttribute, setText } from "./dom.js";
import { hindrance } from "./permissions.js";
import { ORDERS, send } from "./command_forms.js";
import { headline } from "./format.js";

const ARMED_AFTER_MS = 450; // the second half of a double click must not answer the question

/** Buttons and question. onForbidden: called where the daemon no longer takes orders from this browser. */
export class Commands {
  constructor(onForbidden) {
    this.onForbidden = onForbidden;
    this.view = { live: false, control: false, state: null };
    this.asking = null;
    this.pending = null;
    this.armed = false;
    this.arming = null;
    this.dialog = byId("ask");
    this.yes = byId("ask-yes");
    this.no = byId("ask-no");
    this.buttons = Object.fromEntries(Object.keys(ORDERS).map((name) => [name, this.button(name)]));
    byId("buttons").append(...Object.values(this.buttons));
    byId("ask-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.confirm();
    });
    byId("ask-form").addEventListener("input", () => this.look());
    this.no.addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("mousedown", (event) => {
      if (!event.target.closest("button, input, label")) event.preventDefault(); // or the safe button loses the focus
    });
    this.dialog.addEventListener("close", () => {
      if (!this.dialog.open) this.asking = null; // it is told late: the next question may be open by then
    });
  }

  button(name) {
    const label = make("span", { className: "label", textContent: name });
    const hint = make("span", { className: "hint", id: `hint-${name}` });
    const button = make("button", { type: "button", id: `do-${name}` }, label, hint);
    button.classList.toggle("danger", Boolean(ORDERS[name].danger));
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
      const order = view.state ? ORDERS[name].order(view.state) : null;
      const waits = this.pending === name;
      const why = waits ? "asking …" : view.state ? hindrance(name, view) : "no connection";
      if (order) setText(label, order.label);
      setText(hint, why ?? order.hint);
      setAttribute(button, "aria-disabled", why === null ? null : "true");
      setAttribute(button, "aria-busy", waits ? "true" : null);
    }
    this.look();
  }

  press(name) {
    const why = this.view.state ? hindrance(name, this.view) : "no connection";
    if (this.pending) this.say(`${this.pending}: asking, wait for the answer`);
    else if (why !== null) this.say(`${this.buttons[name].children[0].textContent} is not possible: ${why}`);
    else this.ask(name);
  }

  say(text, bad = true) {
    const said = byId("said");
    setText(said, text);
    said.classList.toggle("bad", bad);
  }

  ask(name) {
    const order = ORDERS[name].order(this.view.state);
    this.asking = { name, order };
    setText(byId("ask-title"), order.title);
    setText(byId("ask-what"), order.what);
    setText(this.yes, order.yes);
    setText(this.no, order.no ?? "Cancel");
    setText(byId("ask-answer"), "");
    this.dialog.classList.toggle("danger", Boolean(ORDERS[name].danger));
    byId("ask-fields").replaceChildren(...fields(order));
    this.armed = false;
    clearTimeout(this.arming); // of a question closed before it was armed
    this.arming = setTimeout(() => {
      this.armed = true;
      this.look();
    }, ARMED_AFTER_MS);
    this.look();
    this.dialog.showModal();
    this.no.focus();
  }

  /** Keep the open question true to what is so meanwhile. */
  look() {
    if (!this.asking || !this.view.state) return;
    const { name, order } = this.asking;
    const why = hindrance(name, this.view);
    const tick = byId("ask-fields").querySelector("[type=checkbox]");
    const unticked = order.tick?.must && !tick.checked;
    this.yes.disabled = !this.armed || Boolean(why) || unticked || this.pending !== null;
    const now = this.view.live ? headline(this.view.state).word : "no connection";
    const waiting = this.pending ? "asking …" : unticked ? "tick the box to go on" : "";
    setText(byId("ask-now"), [`Now: ${now}`, why ?? waiting].filter(Boolean).join(" · "));
  }

  async confirm() {
    if (!this.asking || this.yes.disabled || this.pending) return;
    const { name, order } = this.asking;
    const form = byId("ask-form");
    if (!form.reportValidity()) return;
    const body = { ...order.body, ...filledIn(order) };
    this.pending = name;
    this.say("");
    setText(byId("ask-answer"), "");
    this.show(this.view);
    const answer = await send(name, order.path, body);
    this.pending = null;
    this.say(answer.text, !answer.ok);
    if (answer.forbidden) this.onForbidden();
    if (answer.ok || this.asking?.name !== name) {
      if (this.asking?.name === name) this.dialog.close();
    } else {
      setText(byId("ask-answer"), answer.text);
      this.no.focus();
    }
    this.show(this.view);
  }
}

function fields(order) {
  const made = (order.fields ?? []).map((field) => {
    const input = make("input", {
      type: "number", name: field.name, min: field.min, max: field.max, step: "any", inputMode: "decimal",
      value: field.usual ?? "", id: `ask-${field.name}`,
    });
    const step = (by) => {
      const from = input.value === "" ? 0 : Number(input.value);
      input.value = Math.min(field.max, Math.max(field.min, from + by * field.step));
    };
    const less = make("button", { type: "button", textContent: "\u2212", ariaLabel: `${field.label}, less` });
    const more = make("button", { type: "button", textContent: "+", ariaLabel: `${field.label}, more` });
    less.addEventListener("click", () => step(-1));
    more.addEventListener("click", () => step(1));
    const label = make("label", { htmlFor: input.id, textContent: `${field.label}, ${field.unit}` });
    return make("div", { className: "field" }, label, make("div", { className: "stepper" }, less, input, more));
  });
  if (order.tick) {
    const tick = make("input", { type: "checkbox", id: "ask-tick" });
    made.push(make("label", { className: "tick" }, tick, make("span", { textContent: order.tick.label })));
  }
  return made;
}

/** What was filled in; a number left empty is left to the daemon. */
function filledIn(order) {
  const inputs = (order.fields ?? []).map((field) => byId(`ask-${field.name}`));
  const numbers = inputs.filter((input) => input.value !== "").map((input) => [input.name, Number(input.value)]);
  const ticked = order.tick?.body && byId("ask-tick").checked ? order.tick.body : {};
  return { ...Object.fromEntries(numbers), ...ticked };
}
