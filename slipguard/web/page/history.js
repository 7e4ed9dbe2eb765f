// The last minute of samples and marks, and what it says in one sentence.

import { plain, signed } from "./format.js";

export const SPAN_S = 60;
export const GAP_S = 0.35; // samples come every 0.1 s; further apart there was none

/** A minute of samples, oldest first; times are the daemon's. */
export class History {
  constructor() {
    this.samples = [];
    this.marks = [];
  }

  /** All anew: what the daemon remembers of the minute before this page was there. */
  replace(samples) {
    const seen = this.samples.filter((one) => one.slipping);
    this.samples = [...samples];
    for (const one of this.samples) {
      one.slipping ??= seen.some((other) => Math.abs(other.t_s - one.t_s) < 0.06);
    }
  }

  /** One more; one that is not later than the newest is left out, and a clock that began anew begins all anew. */
  add(sample) {
    const last = this.samples.at(-1);
    if (last && sample.t_s < last.t_s - SPAN_S) this.samples = [];
    else if (last && sample.t_s <= last.t_s) return;
    this.samples.push(sample);
    const oldest = sample.t_s - SPAN_S - 1;
    while (this.samples[0].t_s < oldest) this.samples.shift();
    this.marks = this.marks.filter((mark) => mark.at_s >= oldest);
  }

  /** An event to be marked in the charts. */
  mark(at_s, level) {
    this.marks.push({ at_s, level });
  }

  /** When the newest sample was taken; 0 where there is none. */
  get now_s() {
    return this.samples.at(-1)?.t_s ?? 0;
  }

  /** Stretches [from_s, to_s] in which `holds` was true of the samples. */
  stretches(holds) {
    const found = [];
    let open = null;
    for (const one of this.samples) {
      if (!holds(one)) open = null;
      else if (open && one.t_s - open[1] <= GAP_S) open[1] = one.t_s;
      else found.push((open = [one.t_s, one.t_s]));
    }
    return found;
  }
}

/** "−0.3° to +4.1°, known 80 %" of the values of a key; null where it was never known. */
export function summary(samples, key, unit, signs) {
  const values = samples.map((one) => one[key]).filter((value) => value !== null && value !== undefined);
  if (!values.length) return null;
  const word = signs ? (value) => signed(value) : (value) => plain(value);
  const [low, high] = [word(Math.min(...values)), word(Math.max(...values))];
  const range = low === high ? `${low}${unit} throughout` : `${low}${unit} to ${high}${unit}`;
  const share = Math.round((100 * values.length) / samples.length);
  return share < 100 ? `${range}, known ${share} %` : range;
}
