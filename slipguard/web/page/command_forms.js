// What can be asked of the daemon: the words of each button, of its question, and the request it sends.

import { guards } from "./permissions.js";
import { sessionHeaders } from "./session.js";
import { plain } from "./format.js";

const height = { name: "height_mm", label: "Height", unit: "mm", min: 1, max: 2000, step: 5 };

/**
 * By name: label and hint of the button; title, what, yes and no of the question; optional fields (numbers; empty:
 * left to the daemon), tick (must be ticked; with `body` it is only an option), and the request's path and body.
 */
export const ORDERS = {
  grasp: {
    order: (state) => ({
      label: "Grasp",
      hint: `close with ${plain(state.limits.first_force_n)} N`,
      title: "Close the jaws?",
      what: "The jaws close on what is between them. Keep your hands out.",
      yes: "Close the jaws",
      fields: [
        {
          name: "force_n", label: "Force per finger", unit: "N", min: 1, max: state.limits.force_max_n, step: 5,
          usual: state.limits.first_force_n,
        },
      ],
      path: "/grasp",
    }),
  },
  lift: {
    order: (state) => ({
      label: "Lift",
      hint: `up by ${plain(state.limits.lift_height_mm)} mm`,
      title: "Lift the arm?",
      what: "The arm lifts what is held. Keep clear of it.",
      yes: "Lift",
      fields: [{ ...height, usual: state.limits.lift_height_mm }],
      path: "/lift",
    }),
  },
  lower: {
    order: () => ({
      label: "Lower",
      hint: "back down",
      title: "Lower the arm?",
      what: "The arm goes down to where the lift began, or by the height you give. Keep clear of it.",
      yes: "Lower",
      fields: [{ ...height, label: "Height (empty: to where the lift began)", usual: null }],
      path: "/lower",
    }),
  },
  guard: {
    order: (state) =>
      guards(state)
        ? {
            label: "Guard off",
            hint: "slip is then only shown",
            title: "Stop guarding?",
            what: "Slip is then only shown: nothing tightens the grip, nothing stops the arm.",
            yes: "Stop guarding",
            path: "/guard",
            body: { on: false },
          }
        : {
            label: "Guard on",
            hint: "act on slip",
            title: "Guard what is held?",
            what: "From now on the grip is tightened, and the arm stopped, when the object slips.",
            yes: "Guard",
            path: "/guard",
            body: { on: true },
          },
  },
  clear: {
    order: (state) => ({
      label: "Clear fault",
      hint: "once its cause is gone",
      title: "Clear the fault?",
      what: state.fault
        ? `${state.fault.code}: ${state.fault.observed}. First: ${state.fault.what_to_do}. The grip stays as it is.`
        : "The grip stays as it is.",
      yes: "Clear the fault",
      path: "/clear",
    }),
  },
  calibrate: {
    patience_ms: 40000,
    order: () => ({
      label: "Calibrate",
      hint: "jaws open and empty",
      title: "Take no-contact images?",
      what: "The jaws must be open and empty: nothing may touch the gels. Moves nothing, takes a few seconds.",
      yes: "Take the images",
      tick: { label: "Also where contact is seen: the light or the gel has changed", body: { force: true } },
      path: "/calibrate",
    }),
  },
  release: {
    danger: true,
    order: () => ({
      label: "Release",
      hint: "opens: what is held drops",
      title: "Open the jaws?",
      what: "This opens the jaws: what is held drops.",
      yes: "Open the jaws",
      no: "Keep the grip",
      tick: { label: "Yes: it may drop, or it is supported", must: true },
      path: "/release",
      body: { confirm: true },
    }),
  },
};

const PATIENCE_MS = 10000;

/** Ask the daemon. Returns {ok, text, forbidden}: what it said, or why it was not done, in one line. */
export async function send(name, path, body) {
  try {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "content-type": "application/json", ...sessionHeaders() },
      body: JSON.stringify(body),
      signal: AbortSignal.timeout(ORDERS[name].patience_ms ?? PATIENCE_MS),
    });
    const told = await answer.json().catch(() => ({}));
    if (answer.ok) return { ok: true, text: told.message ?? "done" };
    const text = told.error ?? `the daemon answered ${answer.status} without a word`;
    return { ok: false, text, forbidden: answer.status === 401 || answer.status === 403 };
  } catch (error) {
    const why = error.name === "TimeoutError" ? "the daemon did not answer in time" : "the connection broke";
    return { ok: false, text: `${why}: whether it was done is not known; look at the state before you ask again` };
  }
}
