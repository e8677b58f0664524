// Keys: which are the car's, which are commands, and which belong to what has the focus.

import { definition, element } from "../viewer/elements.js";

/** Whether an element uses keys itself, so that they are not the car's. */
function usesKeys(target) {
  if (target.closest?.("dialog, [role=tablist]")) return true;
  return target.matches?.("select, textarea, input:not([type=checkbox], [type=file])") ?? false;
}

/** Let the keys act: `own` are those that something else takes first, by whether it did. */
export function bindKeys(actions, own) {
  document.addEventListener("keydown", (event) => {
    const { key, target } = event;
    if (key === "Escape" && usesKeys(target)) target.blur();
    if (usesKeys(target)) return;
    if (own.commands(event)) { event.preventDefault(); return; }
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (own.drives(event)) { event.preventDefault(); return; }
    // Space and Enter press the button that has the focus, as everywhere.
    if ((key === " " || key === "Enter") && target.closest("button, a, summary, label")) return;
    const action = actions.get(key.toLowerCase());
    if (!action || event.repeat && key !== ".") return;
    event.preventDefault();
    action[2]();
  });
  // What was set with the pointer gives the keys back to the car; who came by the keyboard stays.
  let byPointer = false;
  addEventListener("pointerdown", () => { byPointer = true; }, true);
  addEventListener("keydown", () => { byPointer = false; }, true);
  const giveBack = (event) => {
    if (byPointer && event.target.matches("select, input[type=range], button")) event.target.blur();
  };
  for (const name of ["change", "click"]) addEventListener(name, giveBack);
}

/** All keys in a table, and the main ones in a line. */
export function listKeys(list, line, actions) {
  for (const [name, does, , short] of [["↑ ↓ ← →", "drive; W A S D as well", null, true],
    ...actions.values()]) {
    const { value, number } = definition(list, "", "");
    value.parentNode.firstElementChild.append(...name.split(" ").map((one) => {
      const cap = document.createElement("kbd");
      cap.textContent = one;
      return cap;
    }));
    number.data = does;
    if (!short) continue;
    const item = element(line, "span");
    for (const one of name.split(" ")) element(item, "kbd", {}, one);
    item.append(` ${does.split(/[:,;]/)[0]}`);
  }
}
