// The commands: label of each button, text and fields of its dialog, and the request it sends.

import { isGuarding } from "./permissions.js";
import { sessionHeaders } from "./session.js";
import { plain } from "./format.js";

const HEIGHT = { name: "height_mm", label: "Height", unit: "mm", min: 1, max: 2000, step: 5 };
const TIMEOUT_MS = 10000;

/**
 * By name. form(state) returns: label and hint of the button; title, text, confirm and cancel of the dialog; optional
 * fields (numbers; an empty one uses the daemon's default); an optional checkbox (required, or an option with `body`);
 * path and body of the request.
 */
export const COMMANDS = {
  grasp: {
    form: (state) => ({
      label: "Grasp",
      hint: `close with ${plain(state.limits.first_force_n)} N`,
      title: "Close the jaws?",
      text: "The jaws close on the object between them. Keep your hands out.",
      confirm: "Close the jaws",
      fields: [
        {
          name: "force_n", label: "Force per finger", unit: "N", min: 1, max: state.limits.force_max_n, step: 5,
          initial: state.limits.first_force_n,
        },
        {
          name: "force_limit_n", label: "Force limit for this object (empty: as configured)", unit: "N", min: 1,
          max: state.limits.force_max_n, step: 5, initial: null,
        },
      ],
      path: "/grasp",
    }),
  },
  lift: {
    form: (state) => ({
      label: "Lift",
      hint: `up by ${plain(state.limits.lift_height_mm)} mm`,
      title: "Lift the arm?",
      text: "The arm lifts the held object. Keep clear of it.",
      confirm: "Lift",
      fields: [{ ...HEIGHT, initial: state.limits.lift_height_mm }],
      path: "/lift",
    }),
  },
  lower: {
    form: () => ({
      label: "Lower",
      hint: "back down",
      title: "Lower the arm?",
      text: "The arm moves down to where the lift began, or by the height you enter. Keep clear of it.",
      confirm: "Lower",
      fields: [{ ...HEIGHT, label: "Height (empty: to where the lift began)", initial: null }],
      path: "/lower",
    }),
  },
  guard: {
    form: (state) =>
      isGuarding(state)
        ? {
            label: "Guard off",
            hint: "then slip is only shown",
            title: "Switch the guard off?",
            text: "Slip is then only shown: the grip is not tightened, and the arm is not stopped.",
            confirm: "Switch off",
            path: "/guard",
            body: { on: false },
          }
        : {
            label: "Guard on",
            hint: "act on slip",
            title: "Switch the guard on?",
            text: "When the object slips, the grip is tightened and the arm is stopped.",
            confirm: "Switch on",
            path: "/guard",
            body: { on: true },
          },
  },
  clear: {
    form: (state) => ({
      label: "Clear fault",
      hint: "after its cause is gone",
      title: "Clear the fault?",
      text: state.fault
        ? `${state.fault.code}: ${state.fault.observed}. First: ${state.fault.what_to_do}. The grip does not change.`
        : "The grip does not change.",
      confirm: "Clear the fault",
      path: "/clear",
    }),
  },
  calibrate: {
    timeout_ms: 40000,
    form: () => ({
      label: "Calibrate",
      hint: "jaws open and empty",
      title: "Take background images?",
      text: "The jaws must be open and empty: nothing may touch the gels. Nothing moves; it takes a few seconds.",
      confirm: "Take the images",
      checkbox: { label: "Also if contact is detected (the light or the gel has changed)", body: { force: true } },
      path: "/calibrate",
    }),
  },
  release: {
    danger: true,
    form: () => ({
      label: "Release",
      hint: "opens: the object drops",
      title: "Open the jaws?",
      text: "This opens the jaws, and never closes them: a held object drops. Support it first.",
      confirm: "Open the jaws",
      cancel: "Keep the grip",
      checkbox: { label: "Yes: it may drop, or it is supported", required: true },
      path: "/release",
      body: { confirm: true },
    }),
  },
};

/** Send a request. Returns {ok, text, forbidden}: the daemon's message, or the reason of the failure. */
export async function send(name, path, body) {
  try {
    const response = await fetch(path, {
      method: "POST",
      headers: { "content-type": "application/json", ...sessionHeaders() },
      body: JSON.stringify(body),
      signal: AbortSignal.timeout(COMMANDS[name]?.timeout_ms ?? TIMEOUT_MS),
    });
    const content = await response.json().catch(() => ({}));
    if (response.ok) return { ok: true, text: content.message ?? "done" };
    const text = content.error ?? `the daemon responded with status ${response.status} and no reason`;
    return { ok: false, text, forbidden: response.status === 401 || response.status === 403 };
  } catch (error) {
    const reason = error.name === "TimeoutError" ? "no response from the daemon in time" : "the connection was lost";
    return { ok: false, text: `${reason}: the command may have been executed; check the state before you repeat it` };
  }
}
