// Which commands are possible now. The daemon decides; the page only blocks commands that it would refuse.

const IDLE_ONLY = "only when nothing is held";

/** Return in a few words why a command is not possible now; null if it is. view: {live, control, state}. */
export function blockedReason(command, view) {
  if (!view.live) return "no connection";
  if (!view.control) return "read only";
  return RULES[command](view.state);
}

/** Return whether the guard is on for the held object, so that the guard button switches it off. */
export function isGuarding(state) {
  const notStarted = state.phase === "idle" && state.gripper && state.gripper.holding;
  return Boolean(state.guarding && !notStarted);
}

const RULES = {
  grasp(state) {
    if (state.phase === "fault") return "clear the fault first";
    if (state.phase !== "idle" || (state.gripper && state.gripper.holding)) return IDLE_ONLY;
    if ((state.waiting_for ?? []).length) return "not ready, see the devices";
    return armStopped(state);
  },
  lift: motion,
  lower: motion,
  guard(state) {
    if (isGuarding(state)) return state.phase === "fault" ? "clear the fault first" : null;
    const holding = state.phase !== "idle" || (state.gripper && state.gripper.holding) || state.mode === "guard";
    return holding ? null : "nothing is held";
  },
  clear(state) {
    if (state.phase !== "fault") return "there is no fault";
    return state.putting_down ? "wait until the object is put down" : null;
  },
  calibrate(state) {
    if (state.phase !== "idle") return IDLE_ONLY;
    const gripper = state.gripper;
    if (gripper && (gripper.holding || gripper.moving || gripper.closed_on_nothing)) return "open the jaws first";
    const missing = ["left", "right"].some((name) => (state.devices?.[name]?.state ?? "disconnected") === "disconnected");
    return missing ? "a finger has no frames" : null;
  },
  release() {
    return null;
  },
};

function motion(state) {
  if (state.has_arm === false) return "there is no arm";
  if (state.mode === "guard") return "another program moves the arm";
  if (state.phase === "fault") return "clear the fault first";
  if (state.phase !== "holding") return "only while holding";
  if (state.slipping) return "slipping: wait until it has settled";
  if (!state.arm) return "the arm is not connected";
  return armStopped(state);
}

function armStopped(state) {
  const arm = state.arm;
  return arm && (arm.protective_stop || arm.emergency_stop) ? "reset the arm's stop first" : null;
}
