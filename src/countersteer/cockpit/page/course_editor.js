// A course drawn with the mouse, or with numbers: a corridor of straights and turns, or free walls.

import { TopCamera } from "../viewer/camera.js";
import { drawGhost } from "../viewer/car.js";
import { element, showChoice } from "../viewer/elements.js";
import { drawGoal, drawGrid, drawScaleBar, drawWalls } from "../viewer/floor.js";
import { DEGREES, clamp, signed } from "../viewer/numbers.js";
import { Pen } from "../viewer/pen.js";
import * as say from "./messages.js";

const LENGTH = 0.1, ANGLE = 15;  // m and °, to which a straight and a turn are snapped
const SHARPEST = 150;  // °
const NEAR = 14;  // px from a point that is meant
const WAIT = 120;  // ms after a change until the server is asked for the walls
const EMPTY = { mode: "corridor", points: [[0, 0]], closed: false, width: 1.2, radius: 0,
  start: 0.3, goal: null, walls: [], pose: [0, 0, 0], name: "my-course" };

const round = (value, step) => Math.round(value / step) * step;
const angleOf = ([ax, ay], [bx, by]) => Math.atan2(by - ay, bx - ax) / DEGREES;
const within = (angle) => ((angle + 180) % 360 + 360) % 360 - 180;
const distance = ([ax, ay], [bx, by]) => Math.hypot(bx - ax, by - ay);

/** The straights and turns through corner points; the last turn of a closed course is at the first. */
export function segmentsOf({ points, closed, radius }) {
  const corners = closed ? [...points, points[0]] : points, segments = [];
  for (let i = 1; i < corners.length; i++) {
    segments.push({ straight_m: distance(corners[i - 1], corners[i]), turn_deg: 0, radius_m: 0 });
    const next = corners[i + 1] ?? (closed ? points[1] : null);
    if (!next) break;
    const turn = within(angleOf(corners[i], next) - angleOf(corners[i - 1], corners[i]));
    if (Math.abs(turn) > 1e-6) segments.push({ straight_m: 0, turn_deg: turn, radius_m: radius });
  }
  return segments;
}

export class CourseEditor {
  constructor(panel, canvas, theme, send, redraw) {
    Object.assign(this, { panel, canvas, theme, send, redraw, drawn: structuredClone(EMPTY) });
    Object.assign(this, { past: [], future: [], sketch: null, pointer: null, line: null });
    Object.assign(this, { view: { x: 2, y: 0, scale: 90 }, active: false, trouble: "" });
    this.look({ width: 0, height: 0 });
    this.build();
    this.showValues();
  }

  // ---- the panel ----

  build() {
    const { panel } = this;
    const group = (label, choices, answer) => {
      const box = element(panel, "div", { class: "choice", role: "group", "aria-label": label });
      for (const [value, words] of choices) element(box, "button", { value }, words);
      box.addEventListener("click", (event) => {
        if (event.target.value) answer(event.target.value);
      });
      return box;
    };
    const row = () => element(panel, "div", { class: "row" });
    const button = (parent, words, answer, more = {}) => {
      const made = element(parent, "button", { type: "button", ...more }, words);
      made.addEventListener("click", answer);
      return made;
    };
    this.modes = group("What is drawn", [["corridor", "Corridor"], ["walls", "Free walls"]],
      (mode) => this.change({ mode, closed: false }));
    this.hint = element(panel, "p", { class: "soft" });
    const slider = (name, words, low, high, step, unit) => {
      const label = element(panel, "label", {}, words);
      const input = element(label, "input",
        { type: "range", min: low, max: high, step, "aria-label": words });
      const value = element(label, "output");
      // The whole movement of a slider is one step of undo.
      input.addEventListener("pointerdown", () => this.remember());
      input.addEventListener("input", () => this.adjust(name, Number(input.value)));
      return { name, label, input, show: (at) => {
        input.value = at;
        value.textContent = `${signed(at, step < 0.1 ? 2 : 1)} ${unit}`;
      } };
    };
    this.sliders = [slider("width", "Width", 0.4, 3, 0.05, "m"),
      slider("radius", "Corners", 0, 2, 0.1, "m"), slider("start", "Start", 0, 20, 0.1, "m"),
      slider("goal", "Goal", 0, 20, 0.1, "m"), slider("heading", "Heading", -180, 180, 5, "°")];
    const adding = row();
    this.adding = adding;
    const field = (words, value) => element(element(adding, "span", {}, `${words} `), "input",
      { type: "number", step: "any", value, "aria-label": words });
    const turn = field("Turn, °", 0), straight = field("Straight, m", 2);
    button(adding, "Add", () => this.addSegment(Number(turn.value), Number(straight.value)));
    const tools = row();
    this.undoButton = button(tools, "Undo", () => this.back(this.past, this.future));
    this.redoButton = button(tools, "Redo", () => this.back(this.future, this.past));
    this.closeButton = button(tools, "Close the loop", () => this.close());
    this.startButton = button(tools, "Place the start", () => this.placeStart());
    button(tools, "Clear", () => this.change({ points: [[0, 0]], walls: [], closed: false }));
    const label = element(panel, "label", { class: "wide" }, "Name");
    this.name = element(label, "input", { type: "text", maxlength: 60, value: EMPTY.name });
    const ending = row();
    this.saveButton = button(ending, "Save as TOML", () => this.tell("save"));
    this.driveButton = button(ending, "Drive it", () => this.tell("drive"), { class: "main" });
    this.status = element(panel, "p", { class: "soft", role: "status" });
  }

  showValues() {
    const { drawn, sketch } = this, corridor = drawn.mode === "corridor";
    const length = sketch?.length_m ?? 20;
    showChoice(this.modes, drawn.mode);
    this.hint.textContent = corridor
      ? "Click to set corner points: the first straight goes to the right. Click the first point"
        + " to close the loop. Drag a point to move it."
      : "Click to set points of a wall, and double-click (or Enter) to end it. Each click after"
        + " that begins another wall.";
    for (const { name, label, input, show } of this.sliders) {
      const shows = { width: corridor, radius: corridor, start: corridor,
        goal: corridor && !drawn.closed, heading: !corridor }[name];
      label.hidden = !shows;
      if (name === "start" || name === "goal") input.max = length;
      show({ ...drawn, goal: drawn.goal ?? length, heading: drawn.pose[2] }[name]);
    }
    this.adding.hidden = this.closeButton.hidden = !corridor;
    this.startButton.hidden = corridor;
    this.closeButton.disabled = drawn.closed || drawn.points.length < 3;
    this.undoButton.disabled = !this.past.length;
    this.redoButton.disabled = !this.future.length;
    const ready = this.isEnough() && !this.trouble;
    this.saveButton.disabled = this.driveButton.disabled = !ready;
    this.status.classList.toggle("bad", Boolean(this.trouble));
    this.status.textContent = this.trouble || (sketch && corridor
      ? `${drawn.points.length} points, ${signed(length, 2)} m along the middle`
      : corridor ? "" : `${drawn.walls.length} walls`);
  }

  isEnough() {
    const { mode, points, walls } = this.drawn;
    return mode === "corridor" ? points.length > 1 : walls.length > 0;
  }

  // ---- changes, and the way back ----

  remember() {
    this.past.push(structuredClone(this.drawn));
    this.future = [];
  }

  change(changes) {
    this.remember();
    Object.assign(this.drawn, structuredClone(changes));
    this.changed();
  }

  adjust(name, value) {
    if (name === "heading") this.drawn.pose[2] = value;
    else this.drawn[name] = value;
    this.changed();
  }

  back(from, to) {
    if (!from.length) return;
    to.push(structuredClone(this.drawn));
    this.drawn = from.pop();
    this.line = null;
    this.changed();
  }

  changed() {
    this.trouble = "";
    clearTimeout(this.timer);
    if (this.isEnough()) this.timer = setTimeout(() => this.tell("sketch"), WAIT);
    else this.sketch = null;
    this.showValues();
    this.redraw();
  }

  /** Ask the server to sketch, save or drive what is drawn. */
  tell(action) {
    const { drawn } = this, corridor = drawn.mode === "corridor", [x, y, heading] = drawn.pose;
    this.asked = true;
    this.send(say.drawCourse({
      action, name: this.name.value, closed: drawn.closed && corridor, width_m: drawn.width,
      ...(corridor ? { segments: segmentsOf(drawn), start_distance_m: drawn.start,
        goal_distance_m: drawn.closed ? null : drawn.goal }
        : { walls: drawn.walls.map((points_m) => ({ points_m })), start_x_m: x, start_y_m: y,
          start_heading_deg: heading }),
    }));
  }

  /** The server's answer: the walls, or what is wrong. */
  take(sketch) {
    Object.assign(this, { sketch, trouble: "", asked: false });
    this.showValues();
    this.redraw();
  }

  fail(text) {
    if (!this.asked || !this.active) return;
    Object.assign(this, { trouble: text, asked: false });
    this.showValues();
  }

  close() { if (this.drawn.points.length > 2) this.change({ closed: true }); }

  addSegment(turn, straight) {
    const { points } = this.drawn, last = points.at(-1);
    if (!(straight > 0) || this.drawn.closed) return;
    const before = points.length > 1 ? angleOf(points.at(-2), last) : 0;
    const angle = (before + (points.length > 1 ? clamp(turn, -SHARPEST, SHARPEST) : 0)) * DEGREES;
    this.change({ points: [...points,
      [last[0] + straight * Math.cos(angle), last[1] + straight * Math.sin(angle)]] });
  }

  placeStart() {
    this.placing = true;
    this.status.textContent = "Click where the car starts.";
  }

  /** Keys of the editor: undo, redo, the end of a wall. */
  key(event) {
    const name = event.key.toLowerCase();
    if ((event.ctrlKey || event.metaKey) && name === "z") {
      if (event.shiftKey) this.back(this.future, this.past);
      else this.back(this.past, this.future);
    } else if ((event.ctrlKey || event.metaKey) && name === "y") this.back(this.future, this.past);
    else if (name === "enter" && this.line) this.endLine();
    else return false;
    return true;
  }

  // ---- the pointer ----

  /** The point that a click at `at` adds: a straight in whole steps, a turn in whole angles. */
  snapped(at) {
    const { points } = this.drawn, last = points.at(-1);
    if (points.length === 1) return [Math.max(round(at[0], LENGTH), LENGTH), 0];
    const before = angleOf(points.at(-2), last);
    const turn = clamp(round(within(angleOf(last, at) - before), ANGLE), -SHARPEST, SHARPEST);
    const angle = (before + turn) * DEGREES, length = Math.max(round(distance(last, at), LENGTH), LENGTH);
    return [last[0] + length * Math.cos(angle), last[1] + length * Math.sin(angle)];
  }

  pointAt(at) {
    const near = NEAR / this.view.scale;
    return this.drawn.points.findIndex((point) => distance(point, at) < near);
  }

  click(at) {
    const { drawn } = this, free = at.map((value) => round(value, LENGTH));
    if (this.placing) {
      this.placing = false;
      this.change({ pose: [...free, drawn.pose[2]] });
    } else if (drawn.mode === "walls") {
      if (!this.line) {
        this.line = [free];
        this.redraw();
        return;
      }
      this.line.push(free);
      this.change({ walls: this.line.length === 2 ? [...drawn.walls, this.line]
        : [...drawn.walls.slice(0, -1), this.line] });
    } else if (!drawn.closed) {
      if (drawn.points.length > 2 && this.pointAt(at) === 0) this.close();
      else this.change({ points: [...drawn.points, this.snapped(at)] });
    }
  }

  endLine() {
    this.line = null;
    this.redraw();
  }

  /** Answers to the pointer on the canvas; false leaves it to the view. */
  down(px, py) {
    const at = this.camera.floorAt(px, py), k = this.drawn.mode === "corridor" ? this.pointAt(at) : -1;
    this.grip = { px, py, moved: false, k: k > 0 ? k : null };
  }

  move(px, py) {
    this.pointer = this.camera.floorAt(px, py);
    const { grip } = this;
    if (grip) {
      const dx = px - grip.px, dy = py - grip.py;
      if (!grip.moved && Math.hypot(dx, dy) > 4) {
        grip.moved = true;
        if (grip.k !== null) this.remember();
      }
      if (grip.moved && grip.k !== null) {
        const at = this.pointer.map((value) => round(value, LENGTH));
        // The first straight stays along x, as the course's own axes are.
        this.drawn.points[grip.k] = grip.k === 1 ? [Math.max(at[0], LENGTH), 0] : at;
        this.changed();
      } else if (grip.moved) {
        this.view.x -= dx / this.view.scale;
        this.view.y += dy / this.view.scale;
        Object.assign(grip, { px, py });
      }
    }
    this.redraw();
  }

  up(px, py) {
    const { grip } = this;
    this.grip = null;
    if (grip && !grip.moved) this.click(this.camera.floorAt(px, py));
  }

  zoom(factor, px, py) {
    const [x, y] = this.camera.floorAt(px, py), { view } = this;
    const scale = clamp(view.scale * factor, 8, 800), part = 1 - view.scale / scale;
    Object.assign(view, { x: view.x + (x - view.x) * part, y: view.y + (y - view.y) * part, scale });
    this.redraw();
  }

  // ---- the picture ----

  look(size) {
    const { view } = this;
    this.camera = new TopCamera(view.x, view.y, view.scale, size);
  }

  draw(size, car) {
    const c = this.canvas.getContext("2d"), { theme, drawn, view } = this;
    c.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
    c.clearRect(0, 0, size.width, size.height);
    this.look(size);
    const pen = new Pen(c, this.camera), dot = 5 / view.scale;
    drawGrid(pen, theme, size, { x: view.x, y: view.y }, car);
    const corridor = drawn.mode === "corridor";
    if (this.sketch && this.isEnough()) drawWalls(pen, this.sketch.walls_m, theme, car);
    const lines = corridor ? [drawn.closed ? [...drawn.points, drawn.points[0]] : drawn.points]
      : [...drawn.walls, ...(this.line ? [this.line] : [])];
    for (const line of lines) {
      pen.begin().through(line).stroke(theme.colour(corridor ? "soft" : "wall"),
        { wide: corridor ? 1.5 : 3, dash: corridor ? [6, 5] : [] });
      for (const [x, y] of line) pen.begin().arc(x, y, dot).fill(theme.colour("velocity"));
    }
    this.drawNext(pen, corridor);
    const start = corridor ? this.sketch?.start
      : { x_m: drawn.pose[0], y_m: drawn.pose[1], heading_rad: drawn.pose[2] * DEGREES };
    if (start) {
      drawGhost(pen, car, { x: start.x_m, y: start.y_m, heading: start.heading_rad },
        theme.colour("good"), 1);
    }
    if (corridor && !drawn.closed && this.sketch) this.drawGoalOf(pen);
    drawScaleBar(pen, theme, size);
  }

  /** The line to the point that the next click sets, with its length and turn. */
  drawNext(pen, corridor) {
    const { drawn, pointer, theme } = this, own = this.line ?? [];
    const last = corridor ? drawn.points.at(-1) : own.at(-1);
    if (!pointer || !last || corridor && drawn.closed || this.grip?.moved) return;
    const next = corridor ? this.snapped(pointer) : pointer.map((value) => round(value, LENGTH));
    pen.begin().through([last, next]).stroke(theme.colour("velocity"), { wide: 1.5, dash: [3, 4] });
    const turn = corridor && drawn.points.length > 1
      ? `, ${signed(within(angleOf(last, next) - angleOf(drawn.points.at(-2), last)), 0)}°` : "";
    pen.text(...next, `${signed(distance(last, next), 1)} m${turn}`, { font: theme.font(12.5, 600),
      colour: theme.colour("ink"), around: theme.colour("floor"), dy: -16 });
  }

  drawGoalOf(pen) {
    const { line_m: line, length_m: length } = this.sketch;
    let left = Math.min(this.drawn.goal ?? length, length);
    for (let k = 1; k < line.length; k++) {
      const [a, b] = [line[k - 1], line[k]], long = distance(a, b);
      if (left > long && k < line.length - 1) { left -= long; continue; }
      const [ux, uy] = [(b[0] - a[0]) / long, (b[1] - a[1]) / long], half = this.drawn.width / 2;
      const [x, y] = [a[0] + ux * left, a[1] + uy * left];
      drawGoal(pen, [x - uy * half, y + ux * half, x + uy * half, y - ux * half], this.theme);
      return;
    }
  }
}
