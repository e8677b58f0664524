// The cockpit: it wires the socket, the hands, the viewer's stage and the panels to each other.

import { element, showChoice } from "../viewer/elements.js";
import { onGestures } from "../viewer/gestures.js";
import { clamp, signed } from "../viewer/numbers.js";
import { circlesIn, numbersIn } from "../viewer/panel.js";
import { Stage } from "../viewer/stage.js";
import { Theme } from "../viewer/theme.js";
import { Traces } from "../viewer/traces.js";
import { Brush } from "./brush.js";
import { Connection } from "./connection.js";
import { CourseEditor } from "./course_editor.js";
import { Hands } from "./hands.js";
import { handsPicture } from "./hands_picture.js";
import { bindKeys, listKeys } from "./keyboard.js";
import { Lesson } from "./lesson.js";
import { LiveDrive } from "./live.js";
import * as say from "./messages.js";
import { Meter } from "./meter.js";
import { Parameters, sensorsIn } from "./parameters.js";
import { Recordings } from "./recordings.js";
import {
  CLOCKS, clearTurn, describe, offerClock, showHolds, showOver, showTurn,
} from "./telling.js";

const HEARTBEAT = 50;  // ms between inputs when hands rest
const PANEL = 66, TRACES = 100;  // ms between two pictures of them
const WINDOW = 8;  // s that the traces show
const RAMP_END = 60;  // ° of sideslip with the strongest colour
const LOADED = 1.8;  // the most that a wheel carries, of its load at rest
const SEEN = 8.5;  // lengths of the car around it, so that a person sees what comes
const SAID = 7000;  // ms
const SPEEDY = 2.5;  // m/s, whose arrow is drawn longest until the car goes faster
const LEAST = { speed_mps: [0, 3], sideslip_deg: [-40, 40], yaw_rate_degps: [-200, 200],
  steering_deg: [-25, 25], throttle: [0, 100] };

const part = (id) => document.getElementById(id);
const layers = { sonar: false, forces: true, skids: true, ghosts: false, estimate: false,
  rollouts: false };
const theme = new Theme(RAMP_END);
const live = new LiveDrive();
const stage = new Stage(part("stage"), [live], theme, layers);
const traces = new Traces(part("traces"), [live.recent(WINDOW)], theme);
const meter = new Meter();
const showNumbers = numbersIn(part("numbers"), [live]);
const showHands = handsPicture(part("hands"));
let world = null, role = "lost", seq = 0, dirty = true, showCircles = () => {};
let panelAt = 0, tracesAt = 0, limit = 0;

// ---- the server ----

const connection = new Connection({
  welcome(message) {
    role = message.role;
    part("role").textContent = role === "drives" ? "You drive"
      : "You watch: another page drives";
    if (message.watching > 0 && role === "drives") {
      part("role").textContent += `, ${message.watching} watching`;
    }
    showRole();
  },
  world: takeWorld,
  state(message) {
    if (live.add(message, performance.now() / 1000)) clearTurn();
    dirty = true;
    lesson.follow(world, message);
  },
  turn(message) {
    live.summary.turns.push(message);
    lesson.turned(message);
    showTurn(message);
  },
  ended(message) { result = message; },
  runs(message) {
    recordings.take(message.runs, message.new);
    showRole();
  },
  ghost(message) {
    stage.companions = message.time_s.length ? [{ ...message, car: live.car, walls_m: [] }] : [];
    if (message.time_s.length) tell(`The ghost is ${message.name}.`);
    dirty = true;
  },
  rollouts(message) {
    live.rollouts = [...live.rollouts.slice(-20), message];
  },
  sketch(message) { editor.take(message); },
  busy(message) { busy = message.text; dirty = true; },
  event(message) { tell(message.text); },
  error(message) {
    editor.fail(message.text);
    tell(message.text, true);
  },
  lost() {
    role = "lost";
    part("role").textContent = "The server is gone: trying again …";
    showRole();
  },
});
const send = (message) => connection.send(message);
let result = null, busy = "";

function showRole() {
  part("role").className = `role ${role}`;
  const drives = role === "drives";
  for (const box of [part("menus"), document.querySelector(".controls"), part("side")]) {
    for (const one of box.querySelectorAll("button:not([role=tab]), select, input")) {
      if (!drives) {
        one.dataset.was ??= one.disabled;
        one.disabled = true;
      } else if (one.dataset.was !== undefined) {
        one.disabled = one.dataset.was === "true";
        delete one.dataset.was;
      }
    }
  }
  dirty = true;
}

function fillMenu(menu, items, chosen) {
  const names = items.map((item) => item.name).join("\n");
  if (menu.dataset.names !== names) {
    menu.dataset.names = names;
    menu.replaceChildren();
    for (const { name, label } of items) element(menu, "option", { value: name }, label);
  }
  menu.value = chosen;
}

function takeWorld(message) {
  const another = live.take(message);
  world = message;
  fillMenu(part("course"), world.courses, world.course);
  fillMenu(part("car"), world.cars, world.car);
  fillMenu(part("driver"), world.drivers, world.driver);
  part("seed").value = world.seed;
  parameters.take(world.sliders);
  showSensors(world.sensors);
  brush.take(world.patches);
  part("gyro").setAttribute("aria-pressed", world.gyro.on);
  if (!part("gyro-strength").matches(":active")) part("gyro-strength").value = world.gyro.strength;
  part("gyro-value").textContent = `${signed(Number(part("gyro-strength").value), 2)}×`;
  part("record").setAttribute("aria-pressed", world.recording);
  part("record").querySelector("span").textContent = world.recording ? "Recording" : "Record";
  for (const chip of document.querySelectorAll(".chip[value=rollouts]")) {
    chip.hidden = !world.driver.includes("mppi");
  }
  if (limit !== LOADED * world.limit_n) {
    limit = LOADED * world.limit_n;
    showCircles = circlesIn(part("circles"), live, limit);
  }
  if (another) stage.companions = [];
  stage.measure();
  Object.assign(stage, { fastest: Math.max(stage.fastest, SPEEDY), limit, goal: world.goal_m });
  showRole();
}

let sayTimer = 0;

/** A line to the person, for some seconds. */
function tell(text, bad = false) {
  if (!text) return;
  part("say").textContent = text;
  part("say").classList.toggle("bad", bad);
  part("say").hidden = false;
  clearTimeout(sayTimer);
  sayTimer = setTimeout(() => { part("say").hidden = true; }, SAID);
}

// ---- the panels ----

const parameters = new Parameters(part("parameters"), part("find-parameter"), send);
const showSensors = sensorsIn(part("sensors"), send);
const brush = new Brush({
  factor: part("brush-factor"), size: part("brush-size"),
  factorValue: part("brush-factor-value"), sizeValue: part("brush-size-value"),
  toggle: part("paint-on"), undo: part("paint-undo"), clear: part("paint-clear"),
  count: part("paint-count"),
}, send);
const recordings = new Recordings({
  list: part("run-list"), compare: part("compare"), noGhost: part("no-ghost"), drop: part("drop"),
  upload: part("upload"),
}, send, tell);
const editor = new CourseEditor(part("draw"), stage.canvas, theme, send, () => { dirty = true; });
const lesson = new Lesson(part("lesson"), part("lesson-text"), part("lesson-skip"));
const tabs = [...part("tabs").children];

function openTab(name) {
  for (const tab of tabs) {
    const own = tab.getAttribute("aria-controls"), open = own === name;
    tab.setAttribute("aria-selected", open);
    tab.tabIndex = open ? 0 : -1;
    part(own).hidden = !open;
  }
  editor.active = name === "draw";
  if (name !== "paint") brush.use(false);
  stage.canvas.classList.toggle("aims", editor.active || name === "paint");
  if (name === "paint") brush.use(true);
  showChoices();
}

part("tabs").addEventListener("click", (event) => {
  const name = event.target.getAttribute("aria-controls");
  if (name) openTab(name);
});
part("tabs").addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const next = tabs.at((tabs.indexOf(document.activeElement) + step) % tabs.length);
  next.focus();
  openTab(next.getAttribute("aria-controls"));
});

const tellOver = () =>
  showOver({ state: live.state, role, busy, result, draws: editor.active });

function showState(state, moment) {
  showNumbers(moment);
  showCircles(moment);
  showHands(hands.read(), state);
  showHolds(state, world?.driver ?? "the driver");
  offerClock(state);
  tellOver();
  const words = { ready: "Go", drives: "Pause", paused: "Go on", ended: "Again" };
  part("pause").firstElementChild.textContent = words[state.phase];
  part("hand-over").firstElementChild.textContent =
    state.who === "person" ? `Hand over to ${world?.driver ?? "the driver"}` : "Take back";
  showChoice(part("clock"), state.rate);
  part("time").textContent = `${signed(state.time_s, 2)} s`;
  Object.assign(part("meter").dataset, { picturesPerS: meter.rate.toFixed(1),
    drawingMs: meter.cost.toFixed(2), keyToPictureMs: meter.wait.toFixed(1),
    lagMs: (1000 * state.lag_s).toFixed(0) });
  part("meter").textContent = `${signed(meter.rate, 0)} pictures/s, ${signed(meter.wait, 0)} ms `
    + `from key to picture, lag ${signed(1000 * state.lag_s, 0)} ms`;
}

// ---- the picture ----

function frame() {
  requestAnimationFrame(frame);
  hands.poll();
  const begin = performance.now(), { state } = live;
  const moves = state?.phase === "drives";
  if (editor.active) {
    if (dirty) editor.draw(stage.size, live.car);
    dirty = false;
    tellOver();
    return;
  }
  if (!dirty && !moves) return;
  dirty = false;
  if (!state || !live.time_s.length) { tellOver(); return; }
  const moment = live.moment(begin / 1000);
  stage.fastest = Math.max(stage.fastest, Math.abs(moment.speed));
  stage.patches = brush.shown();
  stage.draw([moment], 0);
  describe(stage.canvas, world, state, moment);
  if (begin - panelAt > PANEL || !moves) {
    panelAt = begin;
    showState(state, moment);
  }
  if (begin - tracesAt > TRACES || !moves) {
    tracesAt = begin;
    traces.follow([live.recent(WINDOW)], [moment.t - WINDOW, moment.t]);
    traces.draw(moment.t);
  }
  meter.drew(state.seq, begin, performance.now());
}

function fitWindow() {
  const floating = getComputedStyle(document.querySelector(".layers")).position === "absolute";
  stage.fit(floating ? 44 : 0, floating ? document.querySelector(".legend").offsetHeight + 12 : 8);
  traces.fit();
  dirty = true;
}

// ---- hands ----

const hands = new Hands((changed) => {
  if (role !== "drives") return;
  const now = performance.now();
  seq += 1;
  if (changed) meter.moved(seq, now);
  send(say.input({ seq, ...hands.read(), source: hands.source, page_time_ms: now }));
  dirty = true;
}, HEARTBEAT);
hands.useThumbs(part("pad-steer"), part("pad-drive"));
part("pads").hidden = !matchMedia("(pointer: coarse)").matches;
if (!part("pads").hidden) stage.rig.choose("course");  // nothing lies under the thumbs then

const control = (action, value = 1) => send(say.control({ action, value }));

function pause() {
  const phase = live.state?.phase;
  if (phase === "ended") control("reset");
  else control(phase === "drives" ? "pause" : "go");
}

function changeClock(by) {
  const at = CLOCKS.findIndex((one) => one >= (live.state?.rate ?? 1) - 1e-9);
  control("slow", CLOCKS[clamp(at + by, 0, CLOCKS.length - 1)]);
}

function useGyro(on, strength) {
  send(say.gyro({ on, strength }));
  part("gyro-value").textContent = `${signed(strength, 2)}×`;
}

const gyroStrength = () => Number(part("gyro-strength").value);
const newestRun = () => part("run-list").querySelector("[data-run]")?.dataset.run;

function markNewest() {
  const run = newestRun();
  if (!run) tell("There is no run to mark yet.", true);
  else {
    send(say.mark({ run, mark: "good" }));
    tell(`${run} is marked good. Runs has all marks.`);
  }
}

const CAMERAS = ["follow", "course", "chase"];
const next = (list, one) => list[(list.indexOf(one) + 1) % list.length];

// Each key: its name, what it does, and whether it stands in the short list below the page.
const ACTIONS = new Map(Object.entries({
  " ": ["space", "pause, go on, or begin again", pause, true],
  p: ["P", "the same", pause],
  r: ["R", "reset: back to the start", () => control("reset"), true],
  h: ["H", "hand over, or take back", handOver, true],
  g: ["G", "gyro, on or off", () => useGyro(!world?.gyro.on, gyroStrength()), true],
  c: ["C", "camera", () => { stage.rig.choose(next(CAMERAS, stage.rig.mode)); showChoices(); },
    true],
  v: ["V", "record, or stop", () => send(say.record({ on: !world?.recording })), true],
  m: ["M", "mark good: the newest run", markNewest, true],
  ".": [".", "pause, then single steps", () => control(
    live.state?.phase === "drives" ? "pause" : "step")],
  "[": ["[", "slower clock", () => changeClock(-1)],
  "]": ["]", "faster clock", () => changeClock(1)],
  "+": ["+", "zoom in", () => zoomBy(1.25)],
  "-": ["−", "zoom out", () => zoomBy(0.8)],
  "?": ["?", "all keys", () => part("help").showModal(), true],
}));
ACTIONS.set("0", ["0", "zoom and view back", () => { stage.rig.reset(); dirty = true; }]);

function handOver() {
  send(say.handOver({ to: live.state?.who === "person" ? "driver" : "person" }));
}

bindKeys(ACTIONS, {
  commands: (event) => editor.active && editor.key(event),
  drives({ key, code }) {
    if (brush.on && live.time_s.length && brush.key(key, [live.x_m.at(-1), live.y_m.at(-1)])) {
      dirty = true;
      return true;
    }
    return hands.press(code);
  },
});

// ---- buttons ----

function showChoices() {
  for (const chip of document.querySelectorAll(".layers .chip")) {
    chip.setAttribute("aria-pressed", layers[chip.value]);
  }
  for (const key of document.querySelectorAll(".legend [data-of]")) {
    key.hidden = !layers[key.dataset.of];
  }
  showChoice(part("camera"), stage.rig.mode);
  dirty = true;
}

function zoomBy(factor, x, y) {
  stage.rig.zoomBy(factor, x, y);
  dirty = true;
}

function onChoice(id, answer) {
  part(id).addEventListener("click", (event) => {
    const value = event.target.closest("button")?.value;
    if (value) answer(value);
    showChoices();
  });
}

const act = (key) => ACTIONS.get(key)[2];
const onClick = (id, answer) => part(id).addEventListener("click", answer);
onChoice("camera", (mode) => stage.rig.choose(mode));
onChoice("zoom", (way) => zoomBy(way === "in" ? 1.25 : 0.8));
onChoice("clock", (rate) => control("slow", Number(rate)));
for (const chip of document.querySelectorAll(".layers .chip")) {
  chip.addEventListener("click", () => {
    layers[chip.value] = !layers[chip.value];
    if (chip.value === "rollouts") send(say.askRollouts({ on: layers.rollouts }));
    showChoices();
  });
}
onClick("pause", pause);
onClick("reset", act("r"));
onClick("step", act("."));
onClick("record", act("v"));
onClick("hand-over", handOver);
onClick("gyro", act("g"));
onClick("reset-parameters", () => parameters.resetAll());
onClick("driver-ghost", () => send(say.askGhost({ of: "driver" })));
onClick("offer-take", () => control("slow", Number(part("offer-take").value)));
onClick("help-button", () => part("help").showModal());
part("help").addEventListener("close", () => {
  if (part("help").returnValue === "lesson") {
    lesson.begin();
    control("reset");
  }
  part("help").returnValue = "";
});
part("gyro-strength").addEventListener("input", () => useGyro(world?.gyro.on ?? true, gyroStrength()));
for (const name of ["course", "car", "driver"]) {
  part(name).addEventListener("change", () => send(say.setUp({ [name]: part(name).value })));
}
part("seed").addEventListener("change", () =>
  send(say.setUp({ seed: clamp(Math.round(Number(part("seed").value)), 0, 2 ** 31 - 1) })));
part("menus").addEventListener("submit", (event) => event.preventDefault());

const place = (event) => {
  const box = stage.canvas.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
};

/** On the stage the pointer draws a course or paints, where these are open; else it moves the view. */
function aim(event, name) {
  if (!editor.active && !brush.on || stage.rig.last?.perspective && !editor.active) return;
  event.stopImmediatePropagation();
  if (name === "down") stage.canvas.setPointerCapture(event.pointerId);
  if (editor.active) editor[name](...place(event));
  else if (name === "down" || name === "move" && event.buttons) {
    brush.paint(...stage.rig.last.floorAt(...place(event)));
  }
  dirty = true;
}

for (const name of ["down", "move", "up"]) {
  stage.canvas.addEventListener(`pointer${name}`, (event) => aim(event, name));
}
stage.canvas.addEventListener("dblclick", (event) => {
  if (!editor.active) return;
  event.stopImmediatePropagation();
  editor.endLine();
});
onGestures(stage.canvas, {
  zoom: (factor, x, y) => (editor.active ? editor.zoom(factor, x, y) : zoomBy(factor, x, y)),
  pan: (dx, dy) => { stage.rig.panBy(dx, dy); dirty = true; },
  reset: () => { stage.rig.reset(); dirty = true; },
}, true);

// ---- the page itself ----

listKeys(part("key-table"), part("keys-line"), ACTIONS);
element(part("keys-line"), "span", { class: "space" });
element(part("keys-line"), "output", { id: "meter" });
part("ramp-end").textContent = `${RAMP_END}°`;
traces.least = LEAST;
stage.rig.lengths = SEEN;
openTab("now");
const watch = new ResizeObserver(fitWindow);
for (const box of [".floor", ".strips"]) watch.observe(document.querySelector(box));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  theme.read();
  fitWindow();
});
fitWindow();
showRole();
requestAnimationFrame(frame);
