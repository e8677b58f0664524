// The drive that goes on, as a drive that the viewer can draw: its series grow with each state.

import { beginOf, endOf, indexAt, momentAt } from "../viewer/drive.js";

const KEPT = 90, SLACK = 10;  // s of the past, and by how much more before the oldest goes
const SERIES = ["time_s", "x_m", "y_m", "heading_rad", "speed_mps", "sideslip_deg",
  "yaw_rate_degps", "steering_deg", "steering_command_deg", "throttle", "battery_v"];
const BELIEVED = ["x_m", "y_m", "heading_rad", "speed_mps", "sideslip_deg", "yaw_rate_degps",
  "longer_m", "shorter_m", "ellipse_rad"];
const OF_WHEEL = ["force_x_n", "force_y_n", "limit_n", "slip_mps", "angle_rad"];
const LONGEST = 0.06;  // s by which a state is carried on
const FORGETS = 0.1;  // part by which a late state moves the clock

const emptyTable = (names) => Object.fromEntries(names.map((name) => [name, []]));
const push = (table, names, values) => {
  for (const name of names) table[name].push(values[name] ?? NaN);
};
const columnsOf = (table) => Object.values(table).filter(Array.isArray);

export class LiveDrive {
  constructor() {
    this.name = "now";
    this.walls_m = [];
    this.car = { length_m: 0.4, width_m: 0.2, center_x_m: 0, wheels: [] };
    this.mounts = [];
    this.clear();
  }

  /** The course and the car; returns whether the course is another, or the car's sensors are. */
  take(world) {
    const place = JSON.stringify([world.walls_m, world.sonar]), another = place !== this.place;
    Object.assign(this, { place, walls_m: world.walls_m, car: world.outline, mounts: world.sonar });
    if (another) this.clear();
    return another;
  }

  /** Forget what was driven. */
  clear() {
    Object.assign(this, emptyTable(SERIES), {
      summary: { turns: [] }, events: [], rollouts: [], state: null, offset: null,
      wheels: [0, 1, 2, 3].map(() => emptyTable(OF_WHEEL)),
      sonar: this.mounts.map((mount) => ({ ...mount, time_s: [], distance_m: [] })),
      guesses: { time_s: [], ...emptyTable(BELIEVED) },
    });
  }

  get estimate() { return this.guesses.time_s.length ? this.guesses : null; }

  /** Add a state that came at `now` (s of the page's clock); returns whether a drive began anew. */
  add(state, now) {
    const anew = Boolean(this.state) && state.time_s < this.state.time_s;
    if (anew) this.clear();
    const known = this.time_s.length && state.time_s <= endOf(this);
    this.state = state;
    this.follow(state, now);
    if (known) return anew;
    push(this, SERIES, state);
    this.wheels.forEach((wheel, k) => push(wheel, OF_WHEEL, state.wheels[k]));
    this.sonar.forEach((sonar, k) => {
      if (!state.sonar_new[k]) return;
      sonar.time_s.push(state.time_s);
      sonar.distance_m.push(state.sonar_m[k] ?? Infinity);
    });
    if (state.estimate) {
      this.guesses.time_s.push(state.time_s);
      push(this.guesses, BELIEVED, state.estimate);
    }
    if (beginOf(this) < state.time_s - KEPT - SLACK) this.forget(state.time_s - KEPT);
    return anew;
  }

  forget(before) {
    const drop = (table, count) => columnsOf(table).forEach((column) => column.splice(0, count));
    const own = Math.max(indexAt(this.time_s, before), 0);
    for (const name of SERIES) this[name].splice(0, own);
    for (const wheel of this.wheels) drop(wheel, own);
    for (const table of [...this.sonar, this.guesses]) {
      drop(table, Math.max(indexAt(table.time_s, before), 0));
    }
  }

  /**
   * The car's clock on the page's: their difference follows the states that come earliest, so that
   * one that was held up does not shake the picture.
   */
  follow(state, now) {
    const moves = state.phase === "drives" ? state.rate : 0;
    if (this.pace !== moves || this.offset === null) this.offset = null;
    this.pace = moves;
    const found = state.time_s - moves * now;
    const late = this.offset === null ? 0 : this.offset - found;
    this.offset = late > 0 && late < 1 ? this.offset - FORGETS * late : found;
  }

  /**
   * The car at `now` (s of the page's clock). The last state is carried on by its velocities: at
   * 50 states a second the car is drawn where it is, not where it was, and errs by millimetres.
   */
  moment(now) {
    const last = endOf(this), { state } = this;
    const ahead = Math.min(Math.max(this.offset + this.pace * now - last, 0), LONGEST);
    const moment = momentAt(this, last);
    if (!this.pace || state.touching || this.time_s.length < 2) return moment;
    const yaw = moment.yawRate * Math.PI / 180, heading = moment.heading + yaw * ahead / 2;
    const c = Math.cos(heading), s = Math.sin(heading);
    moment.x += ahead * (c * state.vx_mps - s * state.vy_mps);
    moment.y += ahead * (s * state.vx_mps + c * state.vy_mps);
    moment.heading += yaw * ahead;
    moment.t += ahead;
    return moment;
  }

  /** The last seconds as a drive, for the traces. */
  recent(seconds) {
    const first = Math.max(indexAt(this.time_s, endOf(this) - seconds), 0);
    const shown = SERIES.filter((name) => name !== "battery_v");  // it hardly changes
    const cut = Object.fromEntries(shown.map((name) => [name, this[name].slice(first)]));
    const guess = this.estimate;
    if (guess) {
      const from = Math.max(indexAt(guess.time_s, cut.time_s[0]), 0);
      cut.estimate = Object.fromEntries(
        Object.entries(guess).map(([name, column]) => [name, column.slice(from)]));
    }
    return { ...cut, car: this.car, walls_m: [], summary: this.summary, events: this.events };
  }
}
