// The first visit: to a drift, one sentence of help at a time.

const DONE = "countersteer-lesson";
// m before the corner at which the next sentence comes, so that it is read in time; ° of sideslip at
// which the tail is out.
const NEAR = 1.5, DRIFTS = 15;

/** Distance (m) from the car to the next corner of the centre line, and the key towards it. */
export function nextCorner(world, state) {
  const line = world.line_m, count = world.closed ? line.length - 1 : line.length;
  const c = Math.cos(state.heading_rad), s = Math.sin(state.heading_rad);
  let best = null;
  for (let k = world.closed ? 0 : 1; k < count - (world.closed ? 0 : 1); k++) {
    const [x, y] = line[k], before = line[(k || count) - 1], after = line[k + 1] ?? line[1];
    const ahead = c * (x - state.x_m) + s * (y - state.y_m);
    const aside = Math.abs(-s * (x - state.x_m) + c * (y - state.y_m));
    if (ahead < -0.2 || aside > 1 || best && best.away < ahead) continue;
    const turned = (x - before[0]) * (after[1] - y) - (y - before[1]) * (after[0] - x);
    best = { away: ahead, side: turned > 0 ? "left" : "right" };
  }
  return best;
}

const TOUCH = matchMedia("(pointer: coarse)").matches;
const GAS = TOUCH ? "the right pad" : "↑ (or W)";
const SIDES = TOUCH ? { left: "the left pad to the left", right: "the left pad to the right" }
  : { left: "← (or A)", right: "→ (or D)" };

export class Lesson {
  constructor(box, text, skip) {
    Object.assign(this, { box, text, step: localStorage.getItem(DONE) ? null : 0, side: "right" });
    skip.addEventListener("click", () => this.end());
    this.show();
  }

  begin() {
    localStorage.removeItem(DONE);
    this.step = 0;
    this.show();
  }

  end() {
    localStorage.setItem(DONE, "yes");
    this.step = null;
    this.show();
  }

  /** Another sentence if a state asks for one. */
  follow(world, state) {
    if (this.step === null || !world || state.who !== "person") return;
    const corner = nextCorner(world, state);
    if (corner) this.side = corner.side;
    if (this.step === 4 && state.phase === "ready") { this.end(); return; }
    if (this.step !== 4 && ["ended", "ready"].includes(state.phase)) this.step = 0;
    else if (this.step < 4 && state.wall_contacts > 0) this.step = 5;
    else if (this.step === 0 && state.speed_mps > 0.3) this.step = 1;
    else if (this.step === 1 && corner && corner.away < NEAR) this.step = 2;
    else if (this.step === 2 && Math.abs(state.sideslip_deg) > DRIFTS) this.step = 3;
    this.show();
  }

  /** A turn's figures have come. */
  turned(turn) {
    if (this.step === null || turn.who !== "person") return;
    this.step = turn.drift && !turn.touched ? 4 : 1;
    this.show();
  }

  show() {
    const key = SIDES[this.side];
    const words = [`Press ${GAS}${TOUCH ? " up" : ""} and hold it: the car drives off.`,
      `Keep holding ${GAS} until the car comes to the corner.`,
      `Now let go of ${GAS} and hold ${key}: the tail swings out.`,
      `That is a drift! Let go of ${key} before the nose points down the next straight.`,
      "You drifted a corner! Go on, or press R for a new start. Each drive is recorded: see Runs.",
      `That was the wall. Press ${TOUCH ? "Reset" : "R"} and steer into the corner a little sooner.`,
    ][this.step];
    this.box.hidden = this.step === null;
    if (words && this.text.textContent !== words) this.text.textContent = words;
  }
}
