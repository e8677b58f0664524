// What the page says of the drive: the last turn, why the car stands, what holds now.

import { element } from "../viewer/elements.js";
import { signed } from "../viewer/numbers.js";
import { nextCorner } from "./lesson.js";

const TURN_SHOWN = 3500;  // ms
const LAGS = 0.25;  // s
export const CLOCKS = [0.1, 0.25, 0.5, 1];

const part = (id) => document.getElementById(id);
let turnTimer = 0;

/** The figures of a turn that has ended: large over the stage for a while, and in the panel. */
export function showTurn(turn) {
  const [angle, far] = [signed(turn.peak_sideslip_deg, 0), signed(turn.heading_overshoot_deg, 0)];
  const title = turn.touched ? `Turn ${turn.number}: wall touched`
    : turn.drift ? `Turn ${turn.number}: drift, ${angle}°` : `Turn ${turn.number}: grip, ${angle}°`;
  const detail = `turned ${far}° too far, in at ${signed(turn.entry_speed_mps, 1)} m/s, `
    + `${signed(turn.duration_s, 1)} s`;
  const banner = part("banner"), last = part("last-turn");
  banner.replaceChildren(title);
  banner.className = `turn-banner ${turn.touched ? "bad" : turn.drift ? "good" : ""}`;
  element(banner, "small", {}, detail);
  clearTimeout(turnTimer);
  turnTimer = setTimeout(() => banner.replaceChildren(), TURN_SHOWN);
  last.replaceChildren();
  Object.assign(last.dataset, { turn: turn.number, drift: turn.drift, touched: turn.touched,
    sideslip: turn.peak_sideslip_deg });
  element(last, "b", { class: turn.touched ? "bad" : turn.drift ? "good" : "" }, title);
  element(last, "p", {}, detail);
}

/** A new drive has no last turn. */
export function clearTurn() {
  const last = part("last-turn");
  last.replaceChildren();
  for (const name of Object.keys(last.dataset)) delete last.dataset[name];
}

/** What lies over the stage: why the car does not move, and what to do. */
export function showOver({ state, role, busy, result, draws }) {
  const box = part("over"), drives = role === "drives";
  let [title, hint] = ["", ""];
  if (role === "lost") [title, hint] = ["No server", "The page tries again by itself."];
  else if (busy) [title, hint] = [busy, "It takes a while the first time."];
  else if (draws || !state) title = "";
  else if (state.phase === "paused") [title, hint] = ["Paused", drives ? "Space goes on" : ""];
  else if (state.phase === "ended" && result) {
    const lap = result.lap_time_s === null ? "" : ` in ${result.lap_time_s.toFixed(2)} s`;
    title = result.verdict + (result.success ? lap : "");
    hint = `${result.drifts} of ${result.turns} turns drifting. ${drives ? "R: again" : ""}`;
  } else if (state.phase === "ready" && drives && part("lesson").hidden) {
    [title, hint] = ["Ready", "Hold ↑ to drive, or H for the driver"];
  }
  const words = `${title}\n${hint}`;
  if (box.dataset.words === words) return;
  box.dataset.words = words;
  box.hidden = !title;
  box.replaceChildren(title);
  element(box, "small", {}, hint);
}

/** What holds now, in the corner of the stage. */
export function showHolds(state, driver) {
  const now = [];
  if (state.who === "driver") now.push(["released", `${driver} drives`]);
  if (state.silent && state.phase === "drives" && state.who === "person") {
    now.push(["lost", "nothing heard from the driver’s page: throttle cut"]);
  }
  if (state.touching) now.push(["fault", "wall"]);
  if (state.rate < 1) now.push(["lost", `clock ${state.rate}×`]);
  const words = now.map(([, text]) => text).join("\n"), box = part("events");
  if (box.dataset.words !== words) {
    box.dataset.words = words;
    box.replaceChildren();
    for (const [kind, text] of now) element(box, "span", { class: `event ${kind}` }, text);
  }
}

/** Offer a slower clock while this machine cannot keep the one that is set. */
export function offerClock(state) {
  const slower = CLOCKS.filter((one) => one < Math.min(state.rate, state.keeps)).at(-1) ?? 0.1;
  const lags = state.phase === "drives" && state.lag_s > LAGS && state.rate > 0.1;
  if (lags && part("offer").hidden) {
    part("offer-text").textContent = `This machine is ${signed(state.lag_s, 1)} s behind: it keeps `
      + `${signed(state.keeps, 2)}× of real time.`;
    part("offer-take").textContent = `Use ${slower}×`;
    part("offer-take").value = slower;
    part("offer").hidden = false;
  } else if (!lags && state.lag_s < LAGS / 2) part("offer").hidden = true;
}

/** The same as the picture, for who reads the page without seeing it. */
export function describe(canvas, world, state, moment) {
  const corner = world && nextCorner(world, state);
  Object.assign(canvas.dataset, {
    time: state.time_s, phase: state.phase, x: moment.x.toFixed(3), y: moment.y.toFixed(3),
    heading: (moment.heading * 180 / Math.PI).toFixed(1), speed: signed(moment.speed, 2),
    sideslip: moment.sideslip.toFixed(1), yawRate: moment.yawRate.toFixed(0),
    course: world?.course ?? "", car: world?.car ?? "", who: state.who,
    contacts: state.wall_contacts, throttle: state.throttle,
    corner: corner ? corner.away.toFixed(2) : "", side: corner?.side ?? "",
  });
}
