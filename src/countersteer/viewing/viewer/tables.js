// Tables: the turns of a drive, the differences between drives, what a run says of itself, CSV.

import { element } from "./elements.js";
import { signed } from "./numbers.js";
import { QUANTITIES } from "./traces.js";

const TURN = [["begin_s", 2], ["duration_s", 2], ["entry_speed_mps", 2], ["peak_sideslip_deg", 0],
  ["peak_yaw_rate_degps", 0], ["heading_overshoot_deg", 0], ["heading_error_deg", 1]];
const COLUMNS = ["time_s", "x_m", "y_m", "heading_rad", "speed_mps", "sideslip_deg",
  "yaw_rate_degps", "steering_deg", "steering_command_deg", "throttle", "commanded_speed_mps",
  "battery_v", "place_m"];

/** A row for each turn; a click goes to its beginning. Returns what marks the one under way. */
export function fillTurns(body, turns, goTo) {
  body.replaceChildren();
  const rows = turns.map((turn, k) => {
    const row = element(body, "tr");
    const jump = element(element(row, "th", { scope: "row" }), "button",
      { "aria-label": `Jump to turn ${k + 1}` }, String(k + 1));
    for (const [name, digits] of TURN) element(row, "td", {}, signed(turn[name], digits));
    // A click on the button reaches the row as well.
    row.addEventListener("click", () => { goTo(turn.begin_s); jump.blur(); });
    return row;
  });
  return (t) => rows.forEach((row, k) =>
    row.classList.toggle("now", turns[k].begin_s <= t && t <= turns[k].end_s));
}

/** Root mean square and largest difference of each drive from the first. */
export function fillDifferences(table, found) {
  table.replaceChildren();
  const shown = [...QUANTITIES.map(({ name, unit, digits, column }) =>
    [name, unit, digits + 1, (one) => one[column]]), ["Apart", "m", 3, (one) => one.apart_m]]
    .filter(([, , , read]) => found.some(read));
  const late = found.some((one) => one.later_s !== undefined);
  const head = element(element(table, "thead"), "tr");
  element(head, "th", {}, "Run");
  const title = (name, unit) => element(element(head, "th", {}, name + " "), "small", {}, unit);
  for (const [name, unit] of shown) title(name, unit);
  if (late) title("Later at the end", "s");
  const body = element(table, "tbody");
  for (const one of found) {
    const row = element(body, "tr");
    element(row, "th", { scope: "row" }, one.run);
    for (const [, , digits, read] of shown) {
      const { rms, largest } = read(one) ?? {};
      const cell = element(row, "td", {}, signed(rms, digits));
      element(cell, "small", {}, ` max ${signed(largest, digits)}`);
    }
    if (late) element(row, "td", {}, signed(one.later_s, 2));
  }
}

/** What a run says of itself. */
export function fillFacts(list, facts) {
  list.replaceChildren();
  for (const [name, text] of facts ?? []) {
    const group = element(list, "div");
    element(group, "dt", {}, name);
    element(group, "dd", name === "Command" ? { class: "command" } : {}, text);
  }
}

/** The series of a drive as CSV, in the digits that the page has; an unknown value is empty. */
export function csvOf(drive) {
  const names = COLUMNS.filter((name) => drive[name]);
  const cell = (value) => (Number.isFinite(value) ? String(+value.toFixed(4)) : "");
  const rows = drive.time_s.map((_, i) => names.map((name) => cell(drive[name][i])).join(","));
  return [names.join(","), ...rows, ""].join("\n");
}

/** Offer a text as a file. */
export function save(name, text) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}
