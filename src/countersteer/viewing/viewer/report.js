// The report: stage, traces, numbers and tables of one drive, or of several side by side.

import {
  beginOf, endOf, hasPath, hasWheels, momentAt, startingTime, unpacked, valueAt,
} from "./drive.js";
import { element, showChoice } from "./elements.js";
import { onGestures } from "./gestures.js";
import { largestOf } from "./numbers.js";
import { circlesIn, fillHeadline, numbersIn, showEvents } from "./panel.js";
import { Playback } from "./playback.js";
import { Stage } from "./stage.js";
import { csvOf, fillDifferences, fillFacts, fillTurns, save } from "./tables.js";
import { Theme } from "./theme.js";
import { Traces } from "./traces.js";

const part = (id) => document.getElementById(id);
const { runs: drives, differences } = unpacked(JSON.parse(part("view").textContent));
const alone = drives.length === 1;
const layers = { sonar: alone, forces: true, skids: true, ghosts: true, estimate: true,
  rollouts: true };
const alignment = { axis: "time_s", differences: false };
let focus = 0;

// The colours' end: rounded up so that the legend reads well, never so small that noise glows.
const rampEnd = Math.max(20,
  Math.ceil(Math.max(...drives.map((one) => largestOf(one.sideslip_deg ?? []))) / 5) * 5);
const theme = new Theme(rampEnd);
const stage = new Stage(part("stage"), drives, theme, layers);
const traces = new Traces(part("traces"), drives, theme);
const clock = new Playback(Math.min(...drives.map(beginOf)), Math.max(...drives.map(endOf)), drawAll);
const showNumbers = numbersIn(part("numbers"), drives);
let showCircles = () => {}, markTurn = () => {};

// ---- the present moment ----

/** Where the clock is on the axis of the traces. */
const cursor = () => (alignment.axis === "time_s" ? clock.t
  : valueAt(drives[0], "place_m", clock.t));

/** The time of a drive that is shown beside the first one: the same, or that of the same place. */
function timeOf(drive) {
  if (alignment.axis === "time_s" || drive === drives[0]) return clock.t;
  return valueAt(drive, "time_s", cursor(), "place_m");
}

function drawAll() {
  const moments = drives.map((drive) => momentAt(drive, timeOf(drive)));
  stage.draw(moments, focus);
  traces.draw(cursor());
  showNumbers(moments[focus]);
  showCircles(moments[focus]);
  showEvents(part("events"), drives[focus], moments[focus].t);
  part("clock").textContent = clock.t.toFixed(2);
  part("scrub").value = 1000 * (clock.t - clock.begin) / Math.max(clock.end - clock.begin, 1e-9);
  markTurn(moments[focus].t);
}

/** Go to a time, or to the moment at which the first drive is at a place. */
function goToCursor(at) {
  clock.goTo(alignment.axis === "time_s" ? at : valueAt(drives[0], "time_s", at, "place_m"));
}

// ---- what is shown ----

function setPlaying(playing) {
  clock.play(playing);
  part("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  part("play").querySelector("path").setAttribute("d",
    playing ? "M3 2h3.5v12H3zM9.5 2H13v12H9.5z" : "M4 1.8v12.4L14 8z");
}

function setFocus(k) {
  focus = k;
  const drive = drives[k], turns = drive.summary.turns ?? [];
  showCircles = circlesIn(part("circles"), drive);
  fillHeadline(part("headline"), drive);
  fillFacts(part("facts"), drive.facts);
  markTurn = fillTurns(part("turns").querySelector("tbody"), turns, goToTurn);
  part("turns").hidden = turns.length === 0;
  part("circles").hidden = part("circles-title").hidden = !hasWheels(drive);
  // Without the wheels the panel is numbers only: a row under the stage instead of a column.
  document.querySelector(".stage-row").classList.toggle("plain", !hasWheels(drive));
  for (const chip of document.querySelectorAll(".chip")) chip.hidden = !has(drive, chip.value);
  showChoices();
}

/** Whether a drive has what a layer shows. */
function has(drive, layer) {
  if (layer === "forces" || layer === "skids") return hasWheels(drive);
  if (layer === "ghosts") return alone;
  const found = drive[layer];
  return Array.isArray(found) ? found.length > 0 : Boolean(found);
}

/** Go to a time of the drive in focus. */
function goToTurn(t) {
  if (alignment.axis === "time_s" || focus === 0) clock.goTo(t);
  else goToCursor(valueAt(drives[focus], "place_m", t));
}

function align(axis, differing) {
  Object.assign(alignment, { axis, differences: differing });
  traces.choose(axis, differing);
  showDifferences();
  showChoices();
  fitWindow();
}

function showDifferences() {
  if (alone) return;
  const by = alignment.axis === "time_s" ? "time" : "place";
  part("differences-by").textContent = by;
  fillDifferences(part("differences"), differences[by]);
}

function showChoices() {
  for (const chip of document.querySelectorAll(".chip")) {
    chip.setAttribute("aria-pressed", layers[chip.value]);
  }
  showChoice(part("camera"), stage.rig.mode);
  showChoice(part("speed"), clock.speed);
  showChoice(part("axis"), alignment.axis);
  showChoice(part("shown"), alignment.differences ? "differences" : "values");
  showChoice(part("runs"), focus);
  part("force-key").hidden = !(hasWheels(drives[focus]) && layers.forces);
  part("rollout-key").hidden = !(drives[focus].rollouts?.length && layers.rollouts);
  part("estimate-key").hidden = !(drives[focus].estimate && layers.estimate);
  part("ellipse-key").hidden = !(largestOf(drives[focus].estimate?.longer_m ?? []) > 0);
  clock.redraw();
}

function zoomBy(factor, x, y) {
  stage.rig.zoomBy(factor, x, y);
  clock.redraw();
}

/** The answer to a click on one of a group of buttons: its value. */
function onChoice(group, answer) {
  group.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button?.value) return;
    answer(button.value);
    showChoices();
  });
}

document.querySelectorAll(".chip").forEach((chip) => chip.addEventListener("click", () => {
  layers[chip.value] = !layers[chip.value];
  showChoices();
}));
onChoice(part("camera"), (mode) => stage.rig.choose(mode));
onChoice(part("zoom"), (way) => zoomBy(way === "in" ? 1.25 : 0.8));
onChoice(part("speed"), (speed) => { clock.speed = Number(speed); });
onChoice(part("axis"), (axis) => align(axis, alignment.differences));
onChoice(part("shown"), (what) => align(alignment.axis, what === "differences"));
onChoice(part("runs"), (k) => setFocus(Number(k)));
part("play").addEventListener("click", () => setPlaying(!clock.playing));
part("scrub").addEventListener("input", () =>
  clock.goTo(clock.begin + part("scrub").value / 1000 * (clock.end - clock.begin)));
part("csv").addEventListener("click", () =>
  save(`${drives[focus].name || "run"}.csv`, csvOf(drives[focus])));

onGestures(stage.canvas, {
  zoom: zoomBy,
  pan: (dx, dy) => { stage.rig.panBy(dx, dy); clock.redraw(); },
  reset: () => { stage.rig.reset(); clock.redraw(); },
}, true);
onGestures(traces.canvas, {
  zoom: (factor, x) => { traces.zoomBy(factor, x); clock.redraw(); },
  pan: (dx) => { traces.panBy(dx); clock.redraw(); },
  drag: (x) => goToCursor(traces.atX(x)),
  reset: () => { traces.reset(); clock.redraw(); },
}, false);

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const step = event.shiftKey ? 0.5 : 0.02;
  const actions = {
    " ": () => setPlaying(!clock.playing),
    ArrowLeft: () => { setPlaying(false); clock.goTo(clock.t - step); },
    ArrowRight: () => { setPlaying(false); clock.goTo(clock.t + step); },
    Home: () => clock.goTo(clock.begin),
    End: () => clock.goTo(clock.end),
    "+": () => zoomBy(1.25),
    "-": () => zoomBy(0.8),
    0: () => { stage.rig.reset(); traces.reset(); clock.redraw(); },
  };
  // The space bar presses the button that has the focus, as everywhere.
  if (event.key === " " && event.target.tagName === "BUTTON") return;
  if (!actions[event.key]) return;
  event.preventDefault();
  actions[event.key]();
});

/** Take what the address asks for: #t=3.2&play=1&speed=0.25&camera=chase&hide=sonar&by=place */
function followAddress() {
  const asked = new URLSearchParams(location.hash.slice(1));
  if (Number.isFinite(parseFloat(asked.get("t")))) clock.goTo(parseFloat(asked.get("t")));
  if (Number(asked.get("speed")) > 0) clock.speed = Number(asked.get("speed"));
  const camera = asked.get("camera");
  if (["follow", "course", "chase"].includes(camera)) stage.rig.choose(camera);
  for (const layer of (asked.get("hide") ?? "").split(",")) if (layer in layers) layers[layer] = false;
  const place = asked.get("by") === "place" && drives.every((one) => one.place_m);
  if (!alone && (place || asked.has("differences"))) {
    align(place ? "place_m" : "time_s", asked.get("differences") === "1");
  }
  if (asked.has("play")) setPlaying(asked.get("play") === "1");
  showChoices();
}

// ---- sizes and colours follow the window ----

function fitWindow() {
  const floating = getComputedStyle(document.querySelector(".layers")).position === "absolute";
  stage.fit(floating ? 44 : 0, floating ? document.querySelector(".legend").offsetHeight + 12 : 8);
  traces.fit();
  // A canvas whose size was set is empty until it is drawn on, so not in the next frame: now.
  drawAll();
}

part("ramp-end").textContent = rampEnd + "°";
part("end").textContent = `/ ${clock.end.toFixed(2)} s`;
document.querySelector(".page").classList.toggle("pathless", !drives.some(hasPath));
part("comparing").hidden = part("runs").hidden = part("compared").hidden = alone;
part("axis").hidden = !drives.every((one) => one.place_m);
part("ramp").hidden = !alone;
for (const [k, drive] of alone ? [] : drives.entries()) {
  const button = element(part("runs"), "button", { value: k });
  element(button, "i", { style: `background:var(--run-${k + 1})` });
  element(button, "span", {}, drive.name);
}
setPlaying(false);
setFocus(0);
showDifferences();
clock.goTo(startingTime(drives[0]));
const watch = new ResizeObserver(fitWindow);  // one for both: it answers once
for (const box of [".page", ".floor"]) watch.observe(document.querySelector(box));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  theme.read();
  fitWindow();
});
fitWindow();
followAddress();
addEventListener("hashchange", followAddress);
