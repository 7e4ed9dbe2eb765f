// Draws one minute of numbers on a canvas, sharp at every screen resolution, in the page's colors.

import { GAP_S, SPAN_S } from "./history.js";

const LEFT = 46;
const RIGHT = 10;
const TOP = 8;
const BOTTOM = 22;
const MARK_COLORS = { fault: "--fault-line", slip: "--slip-line", warning: "--soft" };
const WARNING_HEIGHT = 8; // a warning is a small mark on the time axis, since there may be many

/** Return ticks at steps of 1, 2 or 5 between low and high, at most `most` of them. */
export function ticks(low, high, most) {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const found = [];
  for (let value = Math.ceil(low / step) * step; value <= high + 1e-9; value += step) found.push(value);
  return found.map((value) => Math.round(value / step) * step);
}

/** A canvas that shows plots; `draw` may be called at any rate. */
export class Chart {
  constructor(canvas) {
    this.canvas = canvas;
    this.plot = null;
    this.scheduled = false;
    new ResizeObserver(() => this.schedule()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.schedule());
  }

  /**
   * plot: {now_s, low, high, unit, live, shades: [{from_s, to_s, color}], marks: [{at_s, kind}],
   * levels: [{value, color, label}], bands: [{points: [t_s, low, high][], color}],
   * lines: [{points: [t_s, value][], color, dash}]}; colors are names of custom properties.
   */
  draw(plot) {
    this.plot = plot;
    this.schedule();
  }

  schedule() {
    if (this.scheduled || !this.plot) return;
    this.scheduled = true;
    requestAnimationFrame(() => {
      this.scheduled = false;
      this.paint();
    });
  }

  paint() {
    const { canvas, plot } = this;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (!width || !height) return;
    const scale = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
    }
    const pen = canvas.getContext("2d");
    const style = getComputedStyle(canvas);
    const color = (name) => style.getPropertyValue(name).trim();
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = `12px ${style.fontFamily}`;
    const x = (t_s) => LEFT + ((t_s - plot.now_s + SPAN_S) / SPAN_S) * (width - LEFT - RIGHT);
    const y = (value) => TOP + ((plot.high - value) / (plot.high - plot.low)) * (height - TOP - BOTTOM);
    const place = { pen, x, y, width, height, color };
    paintAxes(place, plot);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, TOP - 2, width - LEFT - RIGHT + 2, height - TOP - BOTTOM + 4);
    pen.clip();
    pen.globalAlpha = plot.live ? 1 : 0.4;
    paintBehind(place, plot);
    for (const band of plot.bands) paintBand(place, band);
    for (const line of plot.lines) paintLine(place, line);
    pen.restore();
    paintLabels(place, plot);
  }
}

function paintAxes({ pen, x, y, width, height, color }, plot) {
  pen.lineWidth = 1;
  pen.fillStyle = color("--soft");
  pen.strokeStyle = color("--line");
  pen.textBaseline = "middle";
  pen.textAlign = "right";
  for (const value of ticks(plot.low, plot.high, Math.max(2, Math.floor(height / 40)))) {
    const at = Math.round(y(value)) + 0.5;
    pen.beginPath();
    pen.moveTo(LEFT, at);
    pen.lineTo(width - RIGHT, at);
    pen.stroke();
    pen.fillText(`${String(value).replace("-", "\u2212")}${plot.unit}`, LEFT - 6, at);
  }
  pen.textBaseline = "alphabetic";
  for (const ago of width < 420 ? [60, 30, 0] : [60, 45, 30, 15, 0]) {
    const at = x(plot.now_s - ago);
    pen.textAlign = ago === 60 ? "left" : ago === 0 ? "right" : "center";
    const newest = plot.live ? "now" : "last";
    pen.fillText(ago ? `${ago} s ago` : newest, at, height - 5);
  }
}

function paintBehind({ pen, x, y, width, height, color }, plot) {
  for (const shade of plot.shades) {
    pen.fillStyle = color(shade.color);
    pen.fillRect(x(shade.from_s), TOP, Math.max(4, x(shade.to_s) - x(shade.from_s)), height - TOP - BOTTOM);
  }
  for (const mark of plot.marks) {
    pen.strokeStyle = color(MARK_COLORS[mark.kind]);
    pen.lineWidth = 2;
    pen.setLineDash([]);
    pen.beginPath();
    pen.moveTo(x(mark.at_s), mark.kind === "warning" ? height - BOTTOM - WARNING_HEIGHT : TOP);
    pen.lineTo(x(mark.at_s), height - BOTTOM);
    pen.stroke();
  }
  for (const level of plot.levels) {
    pen.strokeStyle = color(level.color);
    pen.lineWidth = 1.5;
    pen.setLineDash([2, 4]);
    pen.beginPath();
    pen.moveTo(LEFT, y(level.value));
    pen.lineTo(width - RIGHT, y(level.value));
    pen.stroke();
    pen.setLineDash([]);
  }
}

/** Split points into segments without gaps; an unknown or late point ends a segment. */
function segments(points) {
  const found = [];
  let last = null;
  for (const point of points) {
    if (point[1] === null || point[1] === undefined) {
      last = null;
      continue;
    }
    if (last && point[0] - last[0] <= GAP_S) found.at(-1).push(point);
    else found.push([point]);
    last = point;
  }
  return found;
}

function paintBand({ pen, x, y, color }, band) {
  pen.fillStyle = color(band.color);
  for (const segment of segments(band.points)) {
    pen.beginPath();
    for (const [t_s, low] of segment) pen.lineTo(x(t_s), y(low));
    for (const [t_s, , high] of segment.toReversed()) pen.lineTo(x(t_s), y(high));
    pen.closePath();
    pen.fill();
  }
}

function paintLine({ pen, x, y, color }, line) {
  pen.strokeStyle = color(line.color);
  pen.lineWidth = 2.25;
  pen.lineJoin = "round";
  pen.lineCap = line.dash ? "butt" : "round";
  pen.setLineDash(line.dash ?? []);
  for (const segment of segments(line.points)) {
    pen.beginPath();
    pen.moveTo(x(segment[0][0]), y(segment[0][1]));
    for (const [t_s, value] of segment) pen.lineTo(x(t_s) + 0.01, y(value));
    pen.stroke();
  }
  pen.setLineDash([]);
}

function paintLabels({ pen, y, width, height, color }, plot) {
  if (!plot.lines.some((line) => line.points.some((point) => point[1] !== null && point[1] !== undefined))) {
    pen.fillStyle = color("--soft");
    pen.textAlign = "center";
    if (width > 320) pen.font = pen.font.replace("12px", "14px");
    pen.fillText("not measured in the last minute", (LEFT + width - RIGHT) / 2, (TOP + height - BOTTOM) / 2 - 12);
  }
}
