// Numbers and states as text, in the terms of `slipguard ctl state`.

const MINUS = "\u2212";

/** Format a number with its sign: "+1.2", "−0.4"; "0.0" without. */
export function signed(value, digits = 1) {
  const text = Math.abs(value).toFixed(digits);
  if (Number(text) === 0) return text;
  return (value < 0 ? MINUS : "+") + text;
}

/** Format a number without a plus: "62", "−3". */
export function plain(value, digits = 0) {
  return signed(value, digits).replace("+", "");
}

/** Format a duration: "0.4 s", "12 s", "3 min", "2 h 5 min". */
export function durationText(seconds) {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 120 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** Format the time of a Date: "14:03:09". */
export function timeText(date) {
  return date.toLocaleTimeString("en-GB");
}

const PHASES = {
  idle: ["Idle", "idle"],
  closing: ["Closing", "move"],
  reference: ["Gripped", "hold"],
  lifting: ["Lifting", "move"],
  holding: ["Holding", "hold"],
  lowering: ["Lowering", "move"],
  released: ["Opening", "move"],
};
const HOLDING_PHASES = new Set(["closing", "reference", "lifting", "holding", "lowering"]);

const NEAR_SHARE = 0.5;
const LIMIT_SHARE = 0.8;

/** Return which shares of the force limit and of the rotation limit a held object uses, 0 to 1; null if unknown. */
export function shares(state) {
  if (!HOLDING_PHASES.has(state.phase) || !state.limits) return { force: null, rotation: null };
  const { force_n, limit_n } = forces(state);
  const rotation_deg = state.rotation ? state.rotation.rotation_deg : null;
  return {
    force: force_n === null ? null : force_n / limit_n,
    rotation: rotation_deg === null ? null : Math.abs(rotation_deg) / state.limits.rotation_max_deg,
  };
}

/** Return the tone of a guarded object: its own while far from both limits, else that of the larger share. */
function toneNearLimits(tone, state) {
  const { force, rotation } = shares(state);
  const share = Math.max(force ?? 0, rotation ?? 0);
  return share >= LIMIT_SHARE ? "limit" : share >= NEAR_SHARE ? "near" : tone;
}

/** Summarize the state: {word, detail, tone}; tone: idle hold move near limit slip warn fault. */
export function headline(state) {
  const gripper = state.gripper;
  if (state.phase === "fault") {
    const code = state.fault ? state.fault.code : "see the log";
    return { word: `Fault: ${code}`, detail: faultDetail(state), tone: "fault" };
  }
  const [word, tone] = PHASES[state.phase] ?? [state.phase, "idle"];
  const notes = state.stopped_by_request ? ["stopped by request"] : [];
  if (state.slipping) notes.push(gripper ? `tightening, ${plain(gripper.force_n)} N now` : "tightening");
  if (state.phase === "idle") notes.push(gripper && gripper.holding ? "an object is held, not guarded" : "nothing is held");
  if (state.phase === "reference") notes.push("taking the reference");
  if (state.guarding) {
    if (HOLDING_PHASES.has(state.phase)) notes.push("guarding");
  } else notes.push("NOT guarding: slip is only shown");
  if (state.has_arm === false) notes.push("no arm is stopped: none is configured");
  else if (state.mode === "guard") notes.push("another program moves the arm");
  if (state.no_rotation_reason && HOLDING_PHASES.has(state.phase)) {
    notes.push(`no rotation estimate (${state.no_rotation_reason})`);
  }
  if (state.slipping) return { word: "Slipping", detail: `${word.toLowerCase()}; ${notes.join("; ")}`, tone: "slip" };
  const waiting = waitingTexts(state);
  if (waiting.length && state.phase === "idle") {
    return { word: "Not ready", detail: waiting.join("; "), tone: "warn" };
  }
  if (waiting.length) notes.push(waiting.join("; "));
  return { word, detail: notes.join("; "), tone: state.guarding || state.phase === "idle" ? toneNearLimits(tone, state) : "warn" };
}

function faultDetail(state) {
  const { arm, gripper } = state;
  const motion = arm && arm.moving ? "the arm is still moving" : "the arm is stopped";
  const noArm = state.has_arm === false ? "there is no arm" : "the arm is not connected";
  const armState = state.putting_down ? "the arm is putting the object down" : arm ? motion : noArm;
  if (!gripper) return `${armState}, the gripper is not connected`;
  const force = gripper.force_known === false ? "force unknown" : `${plain(gripper.force_n)} N`;
  return gripper.holding ? `${armState}, the grip is kept: ${force}` : armState;
}

/** Format a rotation, of one finger or of both. */
export function rotationText(rotation_deg, sigma_deg) {
  if (rotation_deg === null || rotation_deg === undefined) return "no estimate";
  return `${signed(rotation_deg)}°\u00a0±\u00a0${sigma_deg.toFixed(1)}°`; // without a line break
}

/** Return the forces of a state in newtons; null if unknown. */
export function forces(state) {
  return {
    force_n: state.gripper && state.gripper.force_known !== false ? state.gripper.force_n : null,
    target_n: state.target_force_n ?? null,
    limit_n: state.limits ? state.limits.force_max_n : null,
  };
}

/** Format the last slip and the tightening that followed, with their age; "" if there was none. */
export function lastSlipText(state) {
  const slip = state.last_slip;
  return slip ? `${durationText(Math.max(state.now_s - slip.at_s, 0))} ago: ${slip.text}` : "";
}

/** Return the display name of a device. */
export function deviceName(name) {
  const fingers = { left: "left finger", right: "right finger" };
  return fingers[name] ?? name;
}

/** Return what the daemon is waiting for, with each device named once. */
function waitingTexts(state) {
  return (state.waiting_for ?? []).map((line) => {
    const [name, ...reason] = line.split(": ");
    return `${deviceName(name)}: ${reason.join(": ")}`;
  });
}

/** Describe the gripper's state in a few words. */
export function gripperText(gripper) {
  if (gripper.fault) return `fault: ${gripper.fault}`;
  if (gripper.auto_released) return "opened by an automatic release; next: slipguard ctl activate";
  if (!gripper.active && gripper.moving) return "not active yet, moving: the jaws may open and close fully";
  if (!gripper.active) return "not activated: slipguard ctl activate";
  const width = `jaws ${plain(gripper.width_mm)} mm apart`;
  if (gripper.moving) return `moving, ${width}`;
  if (gripper.closed_on_nothing) return `closed on nothing, ${width}`;
  return gripper.holding ? `holding, ${width}` : `empty, ${width}`;
}

/** Describe the arm's state in a few words. */
export function armText(arm) {
  if (arm.emergency_stop) return "emergency stop";
  if (arm.protective_stop) return "protective stop";
  return arm.moving ? `moving, ${plain(arm.speed_mm_s)} mm/s` : "at rest";
}
