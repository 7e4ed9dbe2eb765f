// Numbers and states in words, as `slipguard ctl state` says them.

const MINUS = "\u2212";

/** A number with its sign: "+1.2", "−0.4"; "0.0" has none. */
export function signed(value, digits = 1) {
  const text = Math.abs(value).toFixed(digits);
  if (Number(text) === 0) return text;
  return (value < 0 ? MINUS : "+") + text;
}

/** A number without plus: "62", "−3". */
export function plain(value, digits = 0) {
  return signed(value, digits).replace("+", "");
}

/** "0.4 s", "12 s", "3 min", "2 h 5 min". */
export function span(seconds) {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 120 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** Wall-clock time of a Date: "14:03:09". */
export function clock(date) {
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
const AT_STAKE = new Set(["closing", "reference", "lifting", "holding", "lowering"]);

/** What is so, for somebody two metres away: {word, detail, tone}; tone: idle hold move slip warn fault. */
export function headline(state) {
  const gripper = state.gripper;
  if (state.phase === "fault") {
    const code = state.fault ? state.fault.code : "see the log";
    return { word: `Fault: ${code}`, detail: faultDetail(state), tone: "fault" };
  }
  const [word, tone] = PHASES[state.phase] ?? [state.phase, "idle"];
  const notes = [];
  if (state.slipping) notes.push(gripper ? `tightening, ${plain(gripper.force_n)} N now` : "tightening");
  if (state.phase === "idle") notes.push(gripper && gripper.holding ? "something is held, not guarded" : "nothing is held");
  if (state.phase === "reference") notes.push("looking how it lies");
  if (state.guarding) {
    if (AT_STAKE.has(state.phase)) notes.push("guarding");
  } else notes.push("NOT guarding: slip is only shown");
  if (state.mode === "guard") notes.push("another program moves the arm");
  if (state.no_rotation_reason && AT_STAKE.has(state.phase)) notes.push(`the turn cannot be seen (${state.no_rotation_reason})`);
  if (state.slipping) return { word: "Slipping", detail: `${word.toLowerCase()}; ${notes.join("; ")}`, tone: "slip" };
  const waiting = waits(state);
  if (waiting.length && state.phase === "idle") {
    return { word: "Not ready", detail: waiting.join("; "), tone: "warn" };
  }
  if (waiting.length) notes.push(waiting.join("; "));
  return { word, detail: notes.join("; "), tone: state.guarding || state.phase === "idle" ? tone : "warn" };
}

function faultDetail(state) {
  const { arm, gripper } = state;
  const moves = arm && arm.moving ? "the arm is still moving" : "the arm is stopped";
  const way = state.putting_down ? "the arm puts it down" : arm ? moves : "the arm is not heard";
  if (!gripper) return `${way}, the gripper is not heard`;
  return gripper.holding ? `${way}, the grip is kept: ${plain(gripper.force_n)} N` : way;
}

/** The turn of one finger or of both in words. */
export function turnWords(rotation_deg, sigma_deg) {
  return rotation_deg === null || rotation_deg === undefined ? "not told" : `${signed(rotation_deg)}° ± ${sigma_deg.toFixed(1)}°`;
}

/** {force, target, budget} of a state in newtons; null where not known. */
export function forces(state) {
  return {
    force_n: state.gripper ? state.gripper.force_n : null,
    target_n: state.target_force_n ?? null,
    budget_n: state.limits ? state.limits.force_max_n : null,
  };
}

/** What people call a device. */
export function deviceName(name) {
  const fingers = { left: "left finger", right: "right finger" };
  return fingers[name] ?? name;
}

/** A device's own words without its name before them: they stand beside it. */
export function withoutName(name, text) {
  return text && text.startsWith(`${name}: `) ? text.slice(name.length + 2) : text;
}

/** What the daemon waits for, each device named once. */
function waits(state) {
  return (state.waiting_for ?? []).map((line) => {
    const [name, ...why] = line.split(": ");
    return `${deviceName(name)}: ${withoutName(name, why.join(": "))}`;
  });
}

/** What the gripper does, in a few words. */
export function gripperWords(gripper) {
  if (gripper.fault) return `fault: ${gripper.fault}`;
  if (!gripper.active) return "not activated";
  const apart = `jaws ${plain(gripper.width_mm)} mm apart`;
  if (gripper.moving) return `moving, ${apart}`;
  if (gripper.closed_on_nothing) return `closed on nothing, ${apart}`;
  return gripper.holding ? `holding, ${apart}` : `empty, ${apart}`;
}

/** What the arm does, in a few words. */
export function armWords(arm) {
  if (arm.emergency_stop) return "emergency stop";
  if (arm.protective_stop) return "protective stop";
  return arm.moving ? `moving, ${plain(arm.speed_mm_s)} mm/s` : "at rest";
}
