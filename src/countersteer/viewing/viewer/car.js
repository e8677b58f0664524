// The car: a low body with windows, a wing and four wheels, in its own frame.

import { onFloor, wheelAngle } from "./drive.js";
import { LOOK } from "./look.js";

const LOW = 0.12, BELT = 0.42, ROOF = 0.62;  // heights, in widths of the car

/** The points of an outline (in halves of length and width) of a car at a pose. */
function placed(car, pose, outline, shrink = 1) {
  return outline.map(([u, v]) => onFloor(pose, car.center_x_m + u * shrink * car.length_m / 2,
    v * shrink * car.width_m / 2));
}

/** Where the car was: its outline only. */
export function drawGhost(pen, car, pose, colour, alpha) {
  pen.begin().through(placed(car, pose, LOOK.body)).fill(colour, 0.4 * alpha);
  pen.begin().through(closed(placed(car, pose, LOOK.body))).stroke(colour, { alpha });
}

const closed = (points) => [...points, points[0]];

/** The car at a moment, its body tinted with `paint`. */
export function drawCar(pen, car, moment, theme, paint) {
  const unit = car.width_m, ink = theme.colour("ink");
  const body = placed(car, moment, LOOK.body);
  pen.begin().through(body).fill(theme.colour("skid"), 0.18);
  const wheels = car.wheels.map((_, k) => k)
    .sort((a, b) => wheelDepth(pen, car, moment, b) - wheelDepth(pen, car, moment, a));
  if (pen.camera.perspective) for (const k of wheels) drawWheel(pen, car, moment, k, theme);
  drawSides(pen, body, LOW * unit, BELT * unit, theme.colour("glass"), paint);
  pen.begin().through(body, BELT * unit).fill(theme.colour("body")).fill(paint, 0.34);
  const roof = pen.camera.perspective ? ROOF * unit : BELT * unit;
  for (const pane of [LOOK.rearWindow, LOOK.windscreen]) {
    pen.begin().through(placed(car, moment, pane), BELT * unit).fill(theme.colour("glass"));
  }
  if (pen.camera.perspective) {
    drawSides(pen, placed(car, moment, CABIN), BELT * unit, roof, theme.colour("glass"), paint);
    pen.begin().through(placed(car, moment, CABIN, 0.98), roof).fill(theme.colour("body"))
      .fill(paint, 0.34).stroke(ink);
  }
  pen.begin().through(placed(car, moment, LOOK.wing), roof).fill(ink);
  pen.begin().through(closed(body), BELT * unit).stroke(ink, { wide: 1.5 });
  if (!pen.camera.perspective) for (const k of wheels) drawWheel(pen, car, moment, k, theme);
}

const CABIN = [[0.1, 0.5], [0.1, -0.5], [-0.45, -0.48], [-0.45, 0.48]];

function wheelDepth(pen, car, moment, k) {
  return pen.depth(...onFloor(moment, car.wheels[k].x_m, car.wheels[k].y_m));
}

/** The sides of an outline from one height to another, the farthest first. */
function drawSides(pen, outline, low, high, colour, paint) {
  if (!pen.camera.perspective) return;
  closed(outline).slice(1).map((point, i) => [outline[i], point])
    .sort((a, b) => pen.depth(...b[0]) + pen.depth(...b[1])
      - pen.depth(...a[0]) - pen.depth(...a[1]))
    .forEach(([a, b]) => {
      pen.begin().through([[...a, low], [...b, low], [...b, high], [...a, high]])
        .fill(colour).fill(paint, 0.5);
    });
}

function drawWheel(pen, car, moment, k, theme) {
  const wheel = car.wheels[k], [x, y] = onFloor(moment, wheel.x_m, wheel.y_m);
  const hub = { x, y, heading: moment.heading + wheelAngle(moment, k) };
  const tread = [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    .map(([u, v]) => onFloor(hub, u * wheel.radius_m, v * wheel.width_m / 2));
  const top = pen.camera.perspective ? 2 * wheel.radius_m : 0;
  drawSides(pen, tread, 0, top, theme.colour("rubber"), theme.colour("rubber"));
  pen.begin().through(tread, top).fill(theme.colour("rubber"));
}
