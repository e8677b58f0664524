// Quantities over time, or over the place along the first drive's path, one strip each.

import { indexAt, valueAt } from "./drive.js";
import { clamp, signed, tickLabel, ticksBetween } from "./numbers.js";

const MOST_DIFFERENCES = 4000;  // samples of a difference
const NARROW = 640, SHALLOW = 36;  // px: of the canvas, and of a strip whose texts share a line
const EVENT_COLOURS = { fault: "bad", lost: "warn", released: "soft" };

export const QUANTITIES = [
  { name: "Speed", unit: "m/s", digits: 2, column: "speed_mps", colour: "velocity" },
  { name: "Sideslip", unit: "°", digits: 0, column: "sideslip_deg", colour: "slip-mid" },
  { name: "Yaw rate", unit: "°/s", digits: 0, column: "yaw_rate_degps", colour: "soft" },
  { name: "Steering", unit: "°", digits: 0, column: "steering_deg", colour: "soft",
    command: "steering_command_deg" },
  { name: "Throttle", unit: "%", digits: 0, column: "throttle", colour: "soft", factor: 100 },
  { name: "Commanded speed", unit: "m/s", digits: 2, column: "commanded_speed_mps",
    colour: "soft" },
  { name: "Voltage", unit: "V", digits: 2, column: "battery_v", colour: "soft", free: true },
];

const isKnown = (series) => Boolean(series?.some(Number.isFinite));

/** The columns of a drive that a quantity is read from: the command stands in for the angle. */
function columnOf(drive, row) {
  if (isKnown(drive[row.column])) return row.column;
  return row.command && isKnown(drive[row.command]) ? row.command : null;
}

export class Traces {
  constructor(canvas, drives, theme) {
    Object.assign(this, { canvas, drives, theme, axis: "time_s", differences: false, least: {} });
    this.context = canvas.getContext("2d");
    // All but the cursor changes only with the size, the window and the colours, so it is kept.
    this.still = document.createElement("canvas");
    this.measure();
  }

  /** Show other drives: of what goes on, the last seconds. `least`: ranges shown in any case. */
  follow(drives, span) {
    this.drives = drives;
    this.measure();
    this.span = span;
    this.layOut();
    this.drawStill();
  }

  /** Show the drives over `time_s` or `place_m`, or their differences from the first. */
  choose(axis, differences) {
    Object.assign(this, { axis, differences });
    this.measure();
  }

  /** The rows and their lines. Call it again when the drives have grown. */
  measure() {
    const { drives, axis } = this, alone = drives.length === 1;
    const ends = drives.filter((one) => one[axis]).map((one) => one[axis]);
    this.whole = [Math.min(...ends.map((x) => x[0])), Math.max(...ends.map((x) => x.at(-1)))];
    this.span = [...this.whole];
    const compared = this.differences && !alone;
    this.rows = QUANTITIES.filter((row) => drives.some((one) => columnOf(one, row)))
      .map((row) => ({ ...row,
        // A real car tells what was asked of its servo, and not the angle that came of it.
        name: drives.some((one) => columnOf(one, row) === row.column) ? row.name
          : `${row.name} asked`,
        lines: compared ? this.differencesIn(row) : this.linesOf(row) }));
    if (compared && drives.every((one) => one.x_m)) this.rows.push(this.apart());
    if (compared && axis === "place_m") this.rows.push(this.later());
    for (const row of this.rows) scaleRow(row, this.least[row.column]);
    this.events = drives.flatMap((one, k) => (axis === "time_s" ? one.events ?? [] : [])
      .map((event) => ({ ...event, k })));
    this.turns = axis === "time_s" && alone ? drives[0].summary.turns ?? [] : [];
    this.canvas.style.setProperty("--rows", this.rows.length);
  }

  linesOf(row) {
    const { drives, axis } = this, alone = drives.length === 1;
    return drives.flatMap((drive, k) => {
      const column = columnOf(drive, row), x = drive[axis];
      if (!column || !x) return [];
      const scaled = (series) => (row.factor ? series.map((v) => v * row.factor) : series);
      const paint = alone ? { colour: row.colour } : { run: k };
      const lines = [{ x, y: scaled(drive[column]), ...paint, wide: 1.75, area: alone, k,
        name: "actual" }];
      if (!alone) return lines;
      if (row.command && column !== row.command && drive[row.command]) {
        lines.push({ x, y: drive[row.command], colour: "ink", wide: 1, dash: [3, 2.5],
          name: "command" });
      }
      const guess = drive.estimate;
      if (guess?.[row.column] && axis === "time_s") {
        lines.push({ x: guess.time_s, y: guess[row.column], colour: "held-out", wide: 1.25,
          dash: [5, 3], name: "estimate" });
      }
      return lines;
    });
  }

  /** Where the first drive has samples that another one has as well. */
  common(other) {
    const { axis } = this, own = this.drives[0][axis], x = [];
    if (!own || !other[axis]) return x;
    const low = Math.max(own[0], other[axis][0]), high = Math.min(own.at(-1), other[axis].at(-1));
    for (let k = 0; k < MOST_DIFFERENCES; k++) {
      x.push(low + (high - low) * k / (MOST_DIFFERENCES - 1));
    }
    return x;
  }

  compare(name, find) {
    return this.drives.slice(1).map((other, i) => {
      const x = this.common(other);
      return { x, y: x.map((at) => find(this.drives[0], other, at)), run: i + 1, k: i + 1,
        wide: 1.75, name };
    });
  }

  differencesIn(row) {
    const { axis } = this, factor = row.factor ?? 1;
    return this.compare("difference", (first, other, at) => factor
      * (valueAt(other, columnOf(other, row) ?? row.column, at, axis)
        - valueAt(first, columnOf(first, row) ?? row.column, at, axis)));
  }

  apart() {
    const { axis } = this;
    return { name: "Apart", unit: "m", digits: 2, lines: this.compare("apart",
      (first, other, at) => Math.hypot(
        valueAt(other, "x_m", at, axis) - valueAt(first, "x_m", at, axis),
        valueAt(other, "y_m", at, axis) - valueAt(first, "y_m", at, axis))) };
  }

  later() {
    const { axis } = this;
    return { name: "Later", unit: "s", digits: 2, lines: this.compare("later",
      (first, other, at) => valueAt(other, "time_s", at, axis)
        - valueAt(first, "time_s", at, axis)) };
  }

  // ---- size, and the window of time or place ----

  fit() {
    const box = this.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    Object.assign(this, { width: box.width, height: box.height, ratio });
    for (const one of [this.canvas, this.still]) {
      one.width = Math.round(box.width * ratio);
      one.height = Math.round(box.height * ratio);
    }
    this.layOut();
    this.drawStill();
  }

  layOut() {
    const narrow = this.width < NARROW, heading = narrow ? 19 : 0, gap = narrow ? 4 : 7;
    const lane = this.events.length ? 22 : 0, foot = 34, top = 8 + lane, { rows } = this;
    this.narrow = narrow;
    this.lane = lane && { top: 8, bottom: 8 + lane - 7 };
    this.left = narrow ? 40 : 182;
    this.right = this.width - (narrow ? 12 : 22);
    const tall = (this.height - top - foot - gap * rows.length) / rows.length;
    this.low = !narrow && tall < SHALLOW;
    rows.forEach((row, k) => {
      row.top = top + k * (tall + gap) + heading;
      row.bottom = top + k * (tall + gap) + tall;
    });
    this.bottom = rows.length ? rows.at(-1).bottom : top;
  }

  toX(at) {
    const [low, high] = this.span;
    return this.left + (at - low) / Math.max(high - low, 1e-9) * (this.right - this.left);
  }

  /** The time or place under a pixel. */
  atX(x) {
    const [low, high] = this.span;
    return clamp(low + (x - this.left) / (this.right - this.left) * (high - low), low, high);
  }

  zoomBy(factor, x) {
    const at = this.atX(x), least = (this.whole[1] - this.whole[0]) / 2000;
    const [low, high] = this.span.map((end) => at + (end - at) / factor);
    if (high - low < least) return;
    this.span = [Math.max(low, this.whole[0]), Math.min(high, this.whole[1])];
    this.drawStill();
  }

  panBy(dx) {
    const by = -dx / (this.right - this.left) * (this.span[1] - this.span[0]);
    const move = clamp(by, this.whole[0] - this.span[0], this.whole[1] - this.span[1]);
    this.span = this.span.map((end) => end + move);
    this.drawStill();
  }

  reset() {
    this.span = [...this.whole];
    this.drawStill();
  }

  // ---- drawing ----

  paint(line) {
    return line.run === undefined ? this.theme.colour(line.colour) : this.theme.run(line.run);
  }

  drawStill() {
    const c = this.still.getContext("2d"), { theme, rows } = this;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.clearRect(0, 0, this.width, this.height);
    c.lineJoin = "round";
    this.drawTurns(c);
    this.drawEvents(c);
    for (const row of rows) {
      this.drawAxis(c, row);
      c.save();
      c.beginPath();
      c.rect(this.left, row.top - 2, this.right - this.left, row.bottom - row.top + 4);
      c.clip();
      for (const line of row.lines) this.drawLine(c, row, line);
      c.restore();
      this.drawName(c, row);
    }
    this.drawKeys(c);
    c.font = theme.font(11);
    c.textAlign = "center"; c.textBaseline = "top";
    c.fillStyle = theme.colour("soft");
    const least = (this.span[1] - this.span[0]) / Math.max(2, (this.right - this.left) / 84);
    for (const tick of ticksBetween(...this.span, least)) {
      if (this.toX(tick) < this.right - 18) c.fillText(tickLabel(tick), this.toX(tick), this.bottom + 6);
    }
    c.textAlign = "right";
    c.fillText(this.axis === "time_s" ? "time, s" : "place, m", this.right, this.bottom + 19);
  }

  drawTurns(c) {
    this.turns.forEach((turn, k) => {
      const from = Math.max(this.toX(turn.begin_s), this.left);
      const to = Math.min(this.toX(turn.end_s), this.right);
      if (to <= from) return;
      c.fillStyle = this.theme.colour("turn");
      for (const row of this.rows) c.fillRect(from, row.top, to - from, row.bottom - row.top);
      if (to - from < 14) return;
      c.fillStyle = this.theme.colour("soft");
      c.font = this.theme.font(11, 600);
      c.textAlign = "left"; c.textBaseline = "alphabetic";
      c.fillText(k + 1, from + 5, this.rows[0].bottom - 5);
    });
  }

  /** Faults, losses and the released switch, in a lane above the strips. */
  drawEvents(c) {
    if (!this.lane) return;
    const { top, bottom } = this.lane;
    if (!this.narrow) {
      c.fillStyle = this.theme.colour("ink");
      c.font = this.theme.font(12.5, 600);
      c.textAlign = "left"; c.textBaseline = "middle";
      c.fillText("Events", 18, (top + bottom) / 2);
    }
    for (const event of this.events) {
      const from = clamp(this.toX(event.from_s), this.left, this.right);
      const to = clamp(this.toX(event.to_s), this.left, this.right);
      c.fillStyle = this.theme.colour(EVENT_COLOURS[event.kind] ?? "soft");
      if (to > this.left && from < this.right) {
        c.fillRect(from, top, Math.max(to - from, 1.5), bottom - top);
      }
      Object.assign(c, { font: this.theme.font(10.5), textAlign: "left", textBaseline: "middle" });
      if (c.measureText(event.label).width > to - from - 12) continue;
      c.fillStyle = this.theme.colour("card");
      c.fillText(event.label, from + 6, (top + bottom) / 2 + 0.5);
    }
  }

  drawAxis(c, row) {
    const { theme } = this;
    Object.assign(c, { textBaseline: "middle", textAlign: "right", font: theme.font(11) });
    c.lineWidth = 1;
    let labelled = Infinity;
    for (const tick of row.ticks) {
      const y = Math.round(toY(row, tick)) + 0.5;
      c.strokeStyle = theme.colour("line");
      c.globalAlpha = tick === 0 ? 1 : 0.55;
      c.beginPath(); c.moveTo(this.left, y); c.lineTo(this.right, y); c.stroke();
      c.globalAlpha = 1;
      if (labelled - y < 12) continue;
      labelled = y;
      c.fillStyle = theme.colour("soft");
      c.fillText(tickLabel(tick), this.left - 8, y);
    }
  }

  drawLine(c, row, line) {
    const path = new Path2D(), area = new Path2D();
    const zero = toY(row, clamp(0, row.low, row.high));
    for (const piece of this.pieces(row, line)) {
      piece.forEach(([x, y], i) => { if (i) path.lineTo(x, y); else path.moveTo(x, y); });
      if (!line.area) continue;
      area.moveTo(piece[0][0], zero);
      for (const [x, y] of piece) area.lineTo(x, y);
      area.lineTo(piece.at(-1)[0], zero);
    }
    c.fillStyle = c.strokeStyle = this.paint(line);
    c.globalAlpha = 0.1;
    if (line.area && !row.free) c.fill(area);
    c.globalAlpha = 1;
    c.lineWidth = line.wide;
    c.setLineDash(line.dash ?? []);
    c.stroke(path);
    c.setLineDash([]);
  }

  /** The line in pixels, in pieces of known values; a column of pixels has four points at most. */
  pieces(row, { x, y }) {
    const first = Math.max(indexAt(x, this.span[0]), 0);
    const last = Math.min(indexAt(x, this.span[1]) + 1, x.length - 1);
    const each = Math.max(1, Math.floor((last - first) / Math.max(this.right - this.left, 1)));
    const found = [];
    let piece = null;
    const put = (i) => {
      if (!Number.isFinite(y[i])) { piece = null; return; }
      if (!piece) found.push(piece = []);
      piece.push([this.toX(x[i]), toY(row, y[i])]);
    };
    for (let i = first; i <= last; i += each) {
      if (each < 4) {
        for (let j = i; j < Math.min(i + each, last + 1); j++) put(j);
        continue;
      }
      let low = i, high = i;
      for (let j = i; j < Math.min(i + each, last + 1); j++) {
        if (!(y[j] >= y[low])) low = j;
        if (!(y[j] <= y[high])) high = j;
      }
      put(Math.min(low, high));
      put(Math.max(low, high));
    }
    return found;
  }

  drawName(c, row) {
    const { theme, narrow } = this;
    c.textAlign = "left"; c.textBaseline = "middle";
    c.fillStyle = theme.colour("ink");
    c.font = theme.font(this.low ? 11.5 : 12.5, 600);
    c.fillText(`${row.name}, ${row.unit}`, narrow ? this.left : 18,
      narrow ? row.top - 9 : (row.top + row.bottom) / 2 - (this.low ? 0 : 8));
  }

  /** What the kinds of lines are, where there are several; the colours of runs are on the page. */
  drawKeys(c) {
    const kinds = new Map(this.rows.flatMap((row) => row.lines)
      .filter((line) => line.run === undefined).map((line) => [line.name, line]));
    if (kinds.size < 2) return;
    let x = this.narrow ? this.left : 18;
    const y = this.bottom + 24;
    Object.assign(c, { font: this.theme.font(11), textAlign: "left", textBaseline: "middle" });
    for (const [name, line] of kinds) {
      c.strokeStyle = line.dash ? this.paint(line) : this.theme.colour("soft");
      c.lineWidth = line.wide;
      c.setLineDash(line.dash ?? []);
      c.beginPath(); c.moveTo(x, y); c.lineTo(x + 16, y); c.stroke();
      c.setLineDash([]);
      c.fillStyle = this.theme.colour("soft");
      c.fillText(name, x + 20, y);
      x += 32 + c.measureText(name).width;
    }
  }

  /** Draw all of it with the cursor at a time or place. */
  draw(at) {
    const { context: c, rows } = this;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, this.canvas.width, this.canvas.height);
    if (this.still.width) c.drawImage(this.still, 0, 0);
    if (!rows.length || !Number.isFinite(at)) return;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    const x = this.toX(at), inside = x >= this.left - 0.5 && x <= this.right + 0.5;
    c.strokeStyle = this.theme.colour("ink");
    c.lineWidth = 1.25;
    c.beginPath();
    // One line through all strips, but not through the names where these stand between them.
    for (const [from, to] of this.narrow ? rows.map((row) => [row.top, row.bottom])
      : [[rows[0].top - 3, this.bottom + 3]]) {
      if (inside) { c.moveTo(x, from); c.lineTo(x, to); }
    }
    c.stroke();
    for (const row of rows) this.drawValues(c, row, at, inside ? x : null);
  }

  /** The dots on a row's lines, and the values as texts. */
  drawValues(c, row, at, x) {
    const { theme, low } = this, narrow = this.narrow || low;
    const shown = row.lines.filter((line) => line.k !== undefined)
      .map((line) => ({ line, value: valueAt({ x: line.x, y: line.y }, "y", at, "x") }));
    const middle = this.narrow ? row.top - 9 : (row.top + row.bottom) / 2 + (low ? 0 : 8);
    c.font = theme.font(12.5);
    c.textBaseline = "middle";
    c.textAlign = narrow ? "right" : "left";
    let textX = low ? this.left - 40 : narrow ? this.right : 18;
    for (const { line, value } of narrow ? [...shown].reverse() : shown) {
      if (x !== null && Number.isFinite(value)) {
        c.fillStyle = this.paint(line);
        c.strokeStyle = theme.colour("card");
        c.lineWidth = 1.5;
        c.beginPath(); c.arc(x, toY(row, value), 4, 0, 2 * Math.PI); c.fill(); c.stroke();
      }
      const unit = shown.length > 1 || low ? "" : ` ${row.unit}`.replace(" °", "°");
      const text = signed(value, row.digits) + unit;
      c.fillStyle = line.run !== undefined ? this.paint(line)
        : theme.colour(narrow ? "ink" : "soft");
      c.fillText(text, textX, middle);
      textX += (narrow ? -1 : 1) * (c.measureText(text).width + 10);
    }
  }
}

/** The range of a row and its round numbers; `least` is what it shows in any case. */
function scaleRow(row, least) {
  let [low, high] = least ?? (row.free ? [Infinity, -Infinity] : [0, 0]);
  for (const { y } of row.lines) {
    for (const value of y) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  if (!(low <= high)) [low, high] = [0, 1];
  const range = Math.max(high - low, 10 ** -row.digits);
  row.low = low - 0.06 * range;
  row.high = high + 0.06 * range;
  row.ticks = ticksBetween(low, high, range / 4);
}

const toY = (row, value) =>
  row.bottom - (value - row.low) / (row.high - row.low) * (row.bottom - row.top);
