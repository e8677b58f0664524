// What is drawn over the car: velocity, sideslip, forces, estimate and the planner's rollouts.

import { drawGhost } from "./car.js";
import { indexAt, momentAt, onFloor, wheelAngle } from "./drive.js";
import { DEGREES, signed } from "./numbers.js";

const STANDSTILL = 0.05;  // m/s; below it the direction of motion means nothing
const GHOST_EVERY = 0.2, GHOSTS = 7;  // s, and how many
const STALE = 0.3;  // s; rollouts older than that are no longer shown

/** The arrow of the velocity and the wedge of the sideslip reach so far, in lengths of the car. */
const ARROW = 1.9, WEDGE = 1.15;

export function drawGhosts(pen, drive, moment, theme) {
  const begin = drive.time_s[0], newest = Math.ceil((moment.t - begin) / GHOST_EVERY) - 1;
  for (let k = Math.max(newest - GHOSTS + 1, 0); k <= newest; k++) {
    const pose = momentAt(drive, begin + k * GHOST_EVERY);
    const fresh = 1 - (moment.t - pose.t) / (GHOST_EVERY * GHOSTS);
    drawGhost(pen, drive.car, pose, theme.slip(pose.sideslip), 0.8 * fresh);
  }
}

/** The force of each tyre in the circle of its friction limit; `limit` (N) is drawn largest. */
export function drawForces(pen, drive, moment, theme, limit) {
  const metresPerNewton = 0.27 * drive.car.length_m / limit, colour = theme.colour("force");
  moment.wheels.forEach((wheel, k) => {
    const place = drive.car.wheels[k], [x, y] = onFloor(moment, place.x_m, place.y_m);
    pen.begin().arc(x, y, Math.max(wheel.limit, 0) * metresPerNewton)
      .fill(colour, 0.1).stroke(colour, { alpha: 0.7 });
    const angle = moment.heading + wheelAngle(moment, k);
    const cos = Math.cos(angle), sin = Math.sin(angle);
    pen.arrow(x, y, x + (cos * wheel.forceX - sin * wheel.forceY) * metresPerNewton,
      y + (sin * wheel.forceX + cos * wheel.forceY) * metresPerNewton, colour, 2.5);
  });
}

/** Length (m) of the arrow of a velocity; `fastest` (m/s) is drawn longest. */
function arrowLength(drive, moment, fastest) {
  return Math.abs(moment.speed) * ARROW * drive.car.length_m / Math.max(fastest, STANDSTILL);
}

const moves = (moment) => Math.abs(moment.speed) >= STANDSTILL && Number.isFinite(moment.sideslip);

/** The angle from the nose, drawn out with a dashed line, to the velocity. */
export function drawSideslip(pen, drive, moment, theme, fastest) {
  if (!moves(moment)) return;
  const { x, y, heading, sideslip } = moment, course = heading + sideslip * DEGREES;
  const radius = Math.min(WEDGE * drive.car.length_m, arrowLength(drive, moment, fastest));
  const colour = theme.slip(sideslip);
  pen.begin().move(x, y).arc(x, y, radius, heading, course).fill(colour, 0.22);
  pen.begin().arc(x, y, radius, heading, course).stroke(colour, { wide: 1.5 });
  pen.begin().move(x, y)
    .to(x + Math.cos(heading) * radius * 1.12, y + Math.sin(heading) * radius * 1.12)
    .stroke(theme.colour("ink"), { dash: [4, 4] });
}

export function drawVelocity(pen, drive, moment, theme, fastest) {
  if (!moves(moment)) return;
  const course = moment.heading + (moment.backwards ? Math.PI : moment.sideslip * DEGREES);
  const length = arrowLength(drive, moment, fastest);
  pen.arrow(moment.x, moment.y, moment.x + Math.cos(course) * length,
    moment.y + Math.sin(course) * length, theme.colour("velocity"), 3);
}

export function drawSideslipLabel(pen, drive, moment, theme, fastest) {
  const wedge = WEDGE * drive.car.length_m, arrow = arrowLength(drive, moment, fastest);
  if (!moves(moment) || arrow < wedge * 0.5 || Math.abs(moment.sideslip) < 8) return;
  const along = moment.heading + moment.sideslip * DEGREES / 2;
  const radius = Math.min(wedge, arrow) + 19 * pen.metresPerPixel(moment.x, moment.y);
  pen.text(moment.x + Math.cos(along) * radius, moment.y + Math.sin(along) * radius,
    signed(moment.sideslip, 0) + "°",
    { font: theme.font(15, 650), colour: theme.colour("ink"), around: theme.colour("floor") });
}

/** Where the pilot believes the car to be, with the ellipse of its doubt about the place. */
export function drawEstimate(pen, drive, moment, theme) {
  const table = drive.estimate, colour = theme.colour("held-out");
  if (!table || moment.t < table.time_s[0]) return;
  const believed = momentAt(table, moment.t), i = indexAt(table.time_s, moment.t);
  drawGhost(pen, drive.car, believed, colour, 0.55);
  const [longer, shorter, angle] = [table.longer_m[i], table.shorter_m[i], table.ellipse_rad[i]];
  if (!(longer > 0)) return;
  const c = Math.cos(angle), s = Math.sin(angle);
  pen.begin();
  for (let k = 0; k <= 48; k++) {
    const u = longer * Math.cos(k * Math.PI / 24), v = shorter * Math.sin(k * Math.PI / 24);
    pen.to(believed.x + c * u - s * v, believed.y + s * u + c * v);
  }
  pen.fill(colour, 0.12).stroke(colour, { wide: 1.5 });
}

/** The paths that the planner looked at last: the cheaper, the darker; its plan is thick. */
export function drawRollouts(pen, drive, moment, theme) {
  const at = indexAt(drive.rollouts.map((one) => one.time_s), moment.t);
  if (at < 0 || moment.t - drive.rollouts[at].time_s > STALE) return;
  const [plan, ...paths] = drive.rollouts[at].paths;
  const draw = (path, colour, wide, alpha) => {
    pen.begin();
    path.x_m.forEach((x, i) => pen.to(x, path.y_m[i]));
    pen.stroke(theme.colour(colour), { wide, alpha });
  };
  paths.sort((a, b) => b.cost - a.cost).forEach((path, k) =>
    draw(path, "force", 1.25, 0.12 + 0.6 * (k + 1) / paths.length));
  if (plan) draw(plan, "velocity", 3, 1);
}
