// Which commands make sense now. The daemon decides; this only saves the operator a refusal that can be foreseen.

const IDLE_ONLY = "only when nothing is held";

/** Why a command cannot be given now, in a few words; null where it can. view: {live, control, state}. */
export function hindrance(command, view) {
  if (!view.live) return "no connection";
  if (!view.control) return "read only";
  return RULES[command](view.state);
}

/** Whether the guard's button switches it off. */
export function guards(state) {
  const notYet = state.phase === "idle" && state.gripper && state.gripper.holding;
  return Boolean(state.guarding && !notYet);
}

const RULES = {
  grasp(state) {
    if (state.phase === "fault") return "clear the fault first";
    if (state.phase !== "idle" || (state.gripper && state.gripper.holding)) return IDLE_ONLY;
    if ((state.waiting_for ?? []).length) return "not ready, see the devices";
    return stopped(state);
  },
  lift: motion,
  lower: motion,
  guard(state) {
    if (guards(state)) return state.phase === "fault" ? "clear the fault first" : null;
    const something = state.phase !== "idle" || (state.gripper && state.gripper.holding) || state.mode === "guard";
    return something ? null : "nothing is held";
  },
  clear(state) {
    if (state.phase !== "fault") return "there is no fault";
    return state.putting_down ? "wait until it is put down" : null;
  },
  calibrate(state) {
    if (state.phase !== "idle") return IDLE_ONLY;
    const gripper = state.gripper;
    if (gripper && (gripper.holding || gripper.moving || gripper.closed_on_nothing)) return "open the jaws first";
    const dark = ["left", "right"].some((name) => state.devices?.[name]?.state !== "ready");
    return dark ? "a finger gives no frames" : null;
  },
  release() {
    return null;
  },
};

function motion(state) {
  if (state.mode === "guard") return "another program moves the arm";
  if (state.phase === "fault") return "clear the fault first";
  if (state.phase !== "holding") return "only while holding";
  if (state.slipping) return "it slips: wait until it is calm";
  if (!state.arm) return "the arm is not there";
  return stopped(state);
}

function stopped(state) {
  const arm = state.arm;
  return arm && (arm.protective_stop || arm.emergency_stop) ? "end the arm's stop first" : null;
}
