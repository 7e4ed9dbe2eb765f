// The samples and marks of the last minute, and a summary in one sentence.

import { plain, signed } from "./format.js";

export const SPAN_S = 60;
export const GAP_S = 0.35; // samples come every 0.1 s; a longer distance is a gap

/** One minute of samples, oldest first; times are on the daemon's clock. */
export class History {
  constructor() {
    this.samples = [];
    this.marks = [];
  }

  /** Replace all samples by the daemon's history from before this page was opened. */
  replace(samples) {
    this.samples = [...samples];
  }

  /** Add a sample; ignored if it is not newer than the newest. If the clock has restarted, start over. */
  add(sample) {
    const last = this.samples.at(-1);
    if (last && sample.t_s < last.t_s - SPAN_S) this.samples = [];
    else if (last && sample.t_s <= last.t_s) return;
    this.samples.push(sample);
    const oldest = sample.t_s - SPAN_S - 1;
    while (this.samples[0].t_s < oldest) this.samples.shift();
    this.marks = this.marks.filter((mark) => mark.at_s >= oldest);
  }

  /** Add a mark for a fault or a warning; slip is marked by the samples. */
  mark(at_s, level) {
    if (level !== "info") this.marks.push({ at_s, kind: level });
  }

  /** Return the time of the newest sample; 0 if there is none. */
  get now_s() {
    return this.samples.at(-1)?.t_s ?? 0;
  }

  /** Return the periods [from_s, to_s] in which `holds` is true for the samples. */
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

/** Summarize the values of a key: "−0.3° to +4.1°; no value for 20 % of the time"; null if all are unknown. */
export function summary(samples, key, unit, signs) {
  const values = samples.map((one) => one[key]).filter((value) => value !== null && value !== undefined);
  if (!values.length) return null;
  const format = signs ? (value) => signed(value) : (value) => plain(value);
  const [low, high] = [format(Math.min(...values)), format(Math.max(...values))];
  const range = low === high ? `${low}${unit} throughout` : `${low}${unit} to ${high}${unit}`;
  const share = Math.round((100 * values.length) / samples.length);
  return share < 100 ? `${range}; no value for ${100 - share} % of the time` : range;
}
