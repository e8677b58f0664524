// Sliders for the car's parameters, made from the server's list of their declarations.

import { element } from "../viewer/elements.js";
import { signed } from "../viewer/numbers.js";
import * as say from "./messages.js";

const STEPS = 400;  // of a slider
const WIDE = 4;  // a slider goes from the first value over this to it times this, within the limits
const EVERY = 80;  // ms between two values of a slider that is being moved

const written = (value) => {
  if (value === null) return "–";
  const size = Math.abs(value);
  return signed(value, size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 || size === 0 ? 2 : 4);
};

/** The range of a slider around the first value: all that is allowed is too much to aim in. */
function rangeOf({ low, high, first }) {
  if (!first) return [low, high];
  const [least, most] = [first / WIDE, first * WIDE].sort((a, b) => a - b);
  return [Math.max(low ?? least, least), Math.min(high ?? most, most)];
}

/** A parameter's name in words, without its unit, which stands beside the value. */
const inWords = (name, unit) =>
  (unit && unit !== "1" ? name.replace(/_[a-z0-9]+$/, "") : name).replaceAll("_", " ");

export class Parameters {
  constructor(box, search, send) {
    Object.assign(this, { box, send, rows: new Map(), waiting: new Map() });
    search.addEventListener("input", () => this.filter(search.value));
  }

  /** Show the sliders of a world; those that are there stay, so that a drag goes on. */
  take(sliders) {
    const paths = sliders.map((one) => one.path);
    if (paths.join() !== [...this.rows.keys()].join()) this.build(sliders);
    for (const slider of sliders) this.rows.get(slider.path).show(slider);
  }

  build(sliders) {
    this.box.replaceChildren();
    this.rows.clear();
    const groups = new Map();
    for (const slider of sliders) {
      const [, group, name] = slider.path.match(/^(?:(.*)\.)?([^.]*)$/);
      if (!groups.has(group)) {
        const details = element(this.box, "details");
        element(details, "summary", {}, (group ?? "car").replaceAll(".", ", "));
        groups.set(group, details);
      }
      this.rows.set(slider.path, this.row(groups.get(group), slider, name));
    }
    groups.values().next().value?.setAttribute("open", "");
  }

  row(parent, slider, name) {
    const { path, unit, meaning, live } = slider, [low, high] = rangeOf(slider);
    const row = element(parent, "div", { class: "parameter" }), id = `set-${path}`;
    element(row, "label", { for: id }, inWords(name, unit));
    const value = element(row, "output", { for: id });
    const bounded = low !== null && high !== null;
    const hint = `${meaning}${live ? "" : " A change starts a new drive."}`;
    const input = element(row, "input", bounded
      ? { id, type: "range", min: low, max: high, step: (high - low) / STEPS, title: hint }
      : { id, type: "number", step: "any", title: hint });
    const back = element(row, "button", { class: "back", type: "button", "aria-label": `Reset ${name}`,
      title: "Reset" }, "↺");
    element(row, "span", { class: "soft" }, hint);
    const text = (at) => { value.textContent = `${written(at)} ${unit === "1" ? "" : unit}`; };
    input.addEventListener("input", () => {
      text(Number(input.value));
      if (live && bounded) this.soon(path, Number(input.value));
    });
    input.addEventListener("change", () => this.now(path, Number(input.value)));
    back.addEventListener("click", () => this.now(path, null));
    const show = (slider) => {
      const changed = slider.value !== slider.first;
      row.classList.toggle("changed", changed);
      back.hidden = !changed;
      if (this.waiting.has(path) || document.activeElement === input && input.matches(":active")) {
        return;
      }
      if (slider.value !== null) input.value = slider.value;
      text(slider.value);
    };
    return { row, show, search: `${path} ${meaning}`.toLowerCase() };
  }

  /** Send the last of many values, at most so often. */
  soon(path, value) {
    const first = !this.waiting.has(path);
    this.waiting.set(path, value);
    if (!first) return;
    setTimeout(() => {
      if (this.waiting.has(path)) this.now(path, this.waiting.get(path));
    }, EVERY);
  }

  now(path, value) {
    this.waiting.delete(path);
    this.send(say.parameter({ path, value }));
  }

  resetAll() {
    for (const [path, { row }] of this.rows) {
      if (row.classList.contains("changed")) this.now(path, null);
    }
  }

  filter(words) {
    const wanted = words.toLowerCase().split(/\s+/).filter(Boolean);
    for (const { row, search } of this.rows.values()) {
      row.hidden = !wanted.every((word) => search.includes(word));
    }
    for (const group of this.box.querySelectorAll("details")) {
      group.hidden = !group.querySelector(".parameter:not([hidden])");
      if (wanted.length) group.open = true;
    }
  }
}

/** A menu for each sensor: on, off, noisier, failing. */
export function sensorsIn(box, send) {
  const menus = new Map();
  return (sensors) => {
    if (sensors.map((one) => one.name).join() !== [...menus.keys()].join()) {
      box.replaceChildren();
      menus.clear();
      for (const { name, states } of sensors) {
        const row = element(box, "label", { class: "sensor" }, name.replaceAll("_", " "));
        const menu = element(row, "select");
        for (const state of states) element(menu, "option", { value: state }, state);
        menu.addEventListener("change", () => send(say.sensor({ name, state: menu.value })));
        menus.set(name, menu);
      }
    }
    for (const { name, state } of sensors) menus.get(name).value = state;
  };
}
