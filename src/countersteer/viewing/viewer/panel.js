// What is so at the present moment: numbers, friction circles, events; and the headline.

import { beginOf, endOf, eventsAt, hasWheels, largestLimit } from "./drive.js";
import { definition, element } from "./elements.js";
import { largestOf, signed } from "./numbers.js";

const NUMBERS = [
  ["Speed", "m/s", (m) => signed(m.speed, 2)],
  ["Sideslip", "°", (m) => signed(m.sideslip, 0)],
  ["Yaw rate", "°/s", (m) => signed(m.yawRate, 0)],
  ["Steering", "°", (m) => signed(m.steering, 0)],
  ["Throttle", "%", (m) => signed(100 * m.throttle, 0), "throttle"],
  ["Commanded speed", "m/s", (m) => signed(m.commandedSpeed, 2), "commanded_speed_mps"],
  ["Voltage", "V", (m) => signed(m.voltage, 2)],
];
const CIRCLE = 46;  // radius that the largest friction limit of the drive is drawn with
const FORCE_TRAIL = 0.3;  // s of a force's way that is drawn

/** The numbers of a moment of the drives, in a list; returns what shows another moment. */
export function numbersIn(list, drives) {
  list.replaceChildren();
  // A car is commanded by throttle or by speed: the other has no place.
  const known = NUMBERS.filter(([, , , column]) => !column || drives.some((one) => one[column]));
  const made = known.map(([name, unit, read]) => ({ ...definition(list, name, unit), read }));
  return (moment) => { for (const { number, read } of made) number.data = read(moment); };
}

/** The friction circles of a drive's wheels; returns what shows another moment. */
export function circlesIn(box, drive, limit = largestLimit(drive)) {
  box.replaceChildren();
  if (!hasWheels(drive)) return () => {};
  const made = ["Front left", "Front right", "Rear left", "Rear right"].map((name) => circle(box, name));
  // The car's nose is up, so a force to the left points left.
  const place = (x, y) => [-y / limit * CIRCLE, -x / limit * CIRCLE];
  const set = (part, values) => {
    for (const [name, value] of Object.entries(values)) part.setAttribute(name, value);
  };
  return (moment) => made.forEach((parts, k) => {
    const wheel = moment.wheels[k], series = drive.wheels[k], time = drive.time_s;
    const [x, y] = place(wheel.forceX, wheel.forceY);
    const share = wheel.limit > 0 ? Math.hypot(wheel.forceX, wheel.forceY) / wheel.limit : 0;
    parts.share.textContent = `${Math.round(100 * share)} %`;
    set(parts.limit, { r: Math.max(wheel.limit, 0) / limit * CIRCLE });
    set(parts.arrow, { x2: x, y2: y });
    set(parts.dot, { cx: x, cy: y });
    const points = [];
    for (let i = moment.i; i >= 0 && time[i] > moment.t - FORCE_TRAIL; i--) {
      points.push(place(series.force_x_n[i], series.force_y_n[i]).map((v) => v.toFixed(1)));
    }
    set(parts.trail, { points: [[x, y], ...points].join(" ") });
  });
}

function circle(parent, name) {
  const box = element(parent, "div", { class: "wheel" }), line = element(box, "p");
  element(line, "span", {}, name);
  const share = element(line, "b");
  const svg = element(box, "svg", { viewBox: "-50 -50 100 100", "aria-hidden": "true" });
  element(svg, "circle", { class: "largest", r: CIRCLE });
  const limit = element(svg, "circle", { class: "limit" });
  element(svg, "path", { class: "cross", d: `M-${CIRCLE} 0H${CIRCLE}M0-${CIRCLE}V${CIRCLE}` });
  return {
    share, limit, trail: element(svg, "polyline", { class: "trail" }),
    arrow: element(svg, "line", { class: "arrow", x1: 0, y1: 0 }),
    dot: element(svg, "circle", { class: "dot", r: 4.5 }),
  };
}

/** The names of the events that are under way. */
export function showEvents(box, drive, t) {
  const now = eventsAt(drive, t), words = now.map((event) => event.label).join("\n");
  if (box.dataset.words === words) return;
  box.dataset.words = words;
  box.replaceChildren();
  for (const event of now) element(box, "span", { class: `event ${event.kind}` }, event.label);
}

/** The result of a drive and its main figures. */
export function fillHeadline(list, drive) {
  list.replaceChildren();
  const { summary } = drive, turns = summary.turns ?? [];
  const put = (name, unit, text, mood) => {
    const { value, number } = definition(list, name, unit);
    number.data = text;
    if (mood) value.className = mood;
  };
  const status = String(summary.verdict ?? summary.outcome ?? "");
  const said = status.charAt(0).toUpperCase() + status.slice(1);
  const drifted = (summary.drifts ?? turns.length) === turns.length;
  if (status === "not judged") put("Result", "", "Not judged");
  else if (summary.success ?? summary.completed)
    put("Result", "", "✓ " + (said || "Completed"), drifted ? "good" : "");
  else put("Result", "", "✕ " + (said || "Not completed"), "bad");
  if (summary.lap_time_s != null) put("Lap time", "s", summary.lap_time_s.toFixed(2));
  else put("Drive time", "s", (endOf(drive) - beginOf(drive)).toFixed(2));
  const contacts = summary.wall_contacts;
  if (contacts != null) put("Wall contacts", "", String(contacts), contacts > 0 ? "bad" : "");
  if (drive.sideslip_deg) put("Largest sideslip", "°", largestOf(drive.sideslip_deg).toFixed(0));
}
