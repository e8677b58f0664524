// The recorded runs: their list, marks, turns to cut out, ghosts, comparing, and files that come in.

import { element } from "../viewer/elements.js";
import { archived } from "./archive.js";
import { withToken } from "./connection.js";
import * as say from "./messages.js";

const MOST_COMPARED = 6;
const open = (address) => window.open(withToken(address), "_blank", "noopener");
const idIn = (run) => encodeURIComponent(run.id);

export class Recordings {
  /** `tell` shows a line to the person; `bad` says that it is an error. */
  constructor({ list, compare, noGhost, drop, upload }, send, tell) {
    Object.assign(this, { list, compare, send, tell, chosen: new Set() });
    compare.addEventListener("click", () =>
      open(`/report?runs=${[...this.chosen].map(encodeURIComponent).join(",")}`));
    noGhost.addEventListener("click", () => send(say.askGhost({ of: "none" })));
    upload.addEventListener("change", () => {
      this.bring([...upload.files]);
      upload.value = "";
    });
    // A file may be dropped anywhere on the page, so that none opens in place of it.
    addEventListener("dragover", (event) => {
      event.preventDefault();
      drop.classList.add("over-it");
    });
    addEventListener("dragleave", () => drop.classList.remove("over-it"));
    addEventListener("drop", async (event) => {
      event.preventDefault();
      drop.classList.remove("over-it");
      this.bring(await filesOf(event.dataTransfer));
    });
  }

  take(runs, fresh) {
    this.chosen = new Set(runs.map((run) => run.id).filter((id) => this.chosen.has(id)));
    this.list.replaceChildren();
    for (const run of runs) this.row(run, run.id === fresh);
    if (!runs.length) {
      element(this.list, "li", { class: "soft" }, "Nothing is recorded yet: press V, and drive.");
    }
    this.showChosen();
  }

  row(run, fresh) {
    const row = element(this.list, "li", { "data-run": run.id, "data-mark": run.mark });
    const name = element(row, "label", { class: "name" });
    const box = element(name, "input", { type: "checkbox", "aria-label": `Choose ${run.title}` });
    box.checked = this.chosen.has(run.id);
    box.addEventListener("change", () => {
      this.chosen[box.checked ? "add" : "delete"](run.id);
      this.showChosen();
    });
    element(name, "span", {}, run.title);
    if (fresh) element(name, "small", {}, "new");
    const drifts = run.turns ? `, ${run.drifts} of ${run.turns} turns drifting` : "";
    const time = run.time_s === null ? "" : `, ${run.time_s.toFixed(2)} s`;
    element(row, "span", { class: "soft" }, `${run.outcome}${time}${drifts}`);
    const tools = element(row, "div", { class: "row" });
    const link = (words, address, more = {}) => element(tools, "a", {
      href: withToken(address), target: "_blank", rel: "noopener", ...more }, words);
    link("Replay", `/report/${idIn(run)}`);
    this.button(tools, "Ghost", () => say.askGhost({ of: "run", run: run.id }));
    for (const [mark, words] of [["good", "Good"], ["bad", "Bad"]]) {
      const chosen = run.mark === mark;
      const button = this.button(tools, words,
        () => say.mark({ run: run.id, mark: chosen ? "none" : mark }));
      button.value = mark;
      button.setAttribute("aria-pressed", chosen);
    }
    if (run.turns) this.turns(tools, run);
    link("Save", `/download/${idIn(run)}`, { target: "_self", download: "" });
  }

  button(parent, words, message) {
    const button = element(parent, "button", { type: "button" }, words);
    button.addEventListener("click", () => this.send(message()));
    return button;
  }

  /** A menu that makes a run from one turn. */
  turns(parent, run) {
    const menu = element(parent, "select", { "aria-label": "Make a run of one turn" });
    element(menu, "option", { value: "" }, "Trim to …");
    for (let k = 1; k <= run.turns; k++) element(menu, "option", { value: k }, `turn ${k}`);
    menu.addEventListener("change", () => {
      this.send(say.trim({ run: run.id, turn: Number(menu.value) }));
      menu.value = "";
    });
  }

  showChosen() {
    const { size } = this.chosen;
    this.compare.disabled = size < 2 || size > MOST_COMPARED;
    this.compare.textContent = size < 2 ? "Compare: choose two" : `Compare ${size} runs`;
  }

  /** Give files to the server; it says what came of them. */
  async bring(files) {
    for (const { name, body } of files.map((file) => ({ name: file.path ?? file.name,
      body: file.body ?? file }))) {
      this.tell(`Reading ${name} …`);
      try {
        const address = withToken(`/upload?name=${encodeURIComponent(name)}`);
        const answer = await fetch(address, { method: "POST", body });
        const words = (await answer.text()).slice(0, 300);
        this.tell(answer.ok ? words || `${name} is in the list.` : words, !answer.ok);
      } catch {
        this.tell(`${name} could not be sent: the server is gone or it is too large.`, true);
      }
    }
  }
}

/** The files of a drop; a folder comes as one archive. */
async function filesOf(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  const found = [];
  for (const entry of entries) {
    if (entry.isDirectory) {
      found.push({ path: `${entry.name}.zip`, body: await archived(entry) });
    } else {
      found.push(await new Promise((done, fail) => entry.file(done, fail)));
    }
  }
  return found.length ? found : [...transfer.files];
}
