// What lies or stands on the floor: grid, walls, path, skid marks, and the cones of the sonar.

import { hasWheels, indexAt, onFloor } from "./drive.js";
import { LOOK } from "./look.js";
import { DEGREES, clamp, niceStep, tickLabel, ticksBetween } from "./numbers.js";

const TRAIL = 60;  // s of the path and of the marks behind the car that are drawn
const MOST_POINTS = 4000;  // of the whole path
const WALL_HEIGHT = 0.45, SEEN = 30;  // widths of the car; lengths of it, as far as a grid goes
const SKID_LEVELS = 4, SKID_FAINTEST = 0.16;

/** The grid in round metres, from above with its numbers along the edges. */
export function drawGrid(pen, theme, size, moment, car) {
  const { camera } = pen;
  if (camera.perspective) {
    const step = niceStep(car.length_m), reach = SEEN * car.length_m;
    const lines = (at) => ticksBetween(at - reach, at + reach, step);
    pen.begin();
    for (const x of lines(moment.x)) pen.move(x, moment.y - reach).to(x, moment.y + reach);
    for (const y of lines(moment.y)) pen.move(moment.x - reach, y).to(moment.x + reach, y);
    pen.stroke(theme.colour("line"));
    return;
  }
  const step = 56 / camera.scale, c = pen.context;
  const [left, high] = camera.floorAt(0, 0), [right, low] = camera.floorAt(size.width, size.height);
  const columns = ticksBetween(left, right, step), rows = ticksBetween(low, high, step);
  pen.begin();
  for (const x of columns) pen.move(x, low).to(x, high);
  for (const y of rows) pen.move(left, y).to(right, y);
  pen.stroke(theme.colour("grid"));
  Object.assign(c, {
    font: theme.font(10.5), fillStyle: theme.colour("soft"), textBaseline: "bottom",
    textAlign: "center",
  });
  const foot = size.height - size.foot;
  columns.forEach((x) => {
    const [at] = camera.pixel(x - camera.x, 0);
    if (at > 40 && at < size.width - 200) c.fillText(tickLabel(x), at, foot);
  });
  c.textBaseline = "middle";
  c.textAlign = "left";
  rows.forEach((y) => {
    const [, at] = camera.pixel(0, y - camera.y);
    if (at > size.head + 22 && at < foot - 18) c.fillText(tickLabel(y), 6, at);
  });
  c.fillText("y, m", 6, size.head + 10);
  c.textAlign = "right";
  c.textBaseline = "bottom";
  c.fillText("x, m", size.width - 160, foot);
}

/** Discs of floor with another friction: slippery ones blue, grippy ones dark; the rim is faint. */
export function drawPatches(pen, patches, theme) {
  for (const { x_m, y_m, radius_m, friction } of patches) {
    const colour = theme.colour(friction < 1 ? "velocity" : "skid");
    const alpha = 0.05 + 0.25 * Math.min(Math.abs(Math.log2(friction)), 1);
    for (const part of [1, 0.7]) pen.begin().arc(x_m, y_m, part * radius_m).fill(colour, alpha);
  }
}

/** The goal's line: x, y of both ends. */
export function drawGoal(pen, goal, theme) {
  const [x0, y0, x1, y1] = goal;
  pen.begin().move(x0, y0).to(x1, y1)
    .stroke(theme.colour("good"), { wide: 4, dash: [7, 6], cap: "butt", alpha: 0.8 });
}

export function drawWalls(pen, walls, theme, car) {
  const colour = theme.colour("wall"), height = WALL_HEIGHT * car.width_m;
  if (pen.camera.perspective) {
    for (const [x0, y0, x1, y1] of walls) {
      pen.begin().through([[x0, y0, 0], [x1, y1, 0], [x1, y1, height], [x0, y0, height]])
        .fill(colour, 0.22);
    }
  }
  pen.begin();
  for (const [x0, y0, x1, y1] of walls) {
    pen.move(x0, y0, height).to(x1, y1, height);
  }
  if (pen.camera.perspective) pen.stroke(colour, { wide: 2.5 });
  else pen.stroke(colour, { wide: 4, metres: 0.05 * car.length_m });
}

/** The whole path, faintly. */
export function drawWholePath(pen, drive, colour, alpha = 0.3) {
  const every = Math.max(1, Math.ceil(drive.x_m.length / MOST_POINTS));
  pen.begin();
  for (let i = 0; i < drive.x_m.length; i += every) pen.to(drive.x_m[i], drive.y_m[i]);
  pen.stroke(colour, { wide: 1.25, alpha });
}

/** The path behind the car, coloured by sideslip, or in one colour if one is given. */
export function drawDrivenPath(pen, drive, moment, theme, colour) {
  const first = Math.max(indexAt(drive.time_s, moment.t - TRAIL), 0);
  const step = (i) => (colour ? 0 : theme.slipStep(drive.sideslip_deg?.[i]));
  const every = Math.max(1, Math.ceil((moment.i - first) / (MOST_POINTS / 2)));
  let level = step(first);
  pen.begin();
  for (let i = first; i <= moment.i; i += every) {
    pen.to(drive.x_m[i], drive.y_m[i]);
    if (step(i) === level) continue;
    pen.stroke(theme.ramp[level], { wide: 2.5 });
    level = step(i);
    pen.begin().to(drive.x_m[i], drive.y_m[i]);
  }
  pen.to(moment.x, moment.y).stroke(colour ?? theme.ramp[level], { wide: 2.5 });
}

/** The marks of the tyres, the darker the faster they slip. */
export function drawSkids(pen, drive, moment, theme) {
  if (!hasWheels(drive)) return;
  const first = Math.max(indexAt(drive.time_s, moment.t - TRAIL), 0);
  const every = Math.max(1, Math.ceil((moment.i - first) / MOST_POINTS));
  const levels = Array.from({ length: SKID_LEVELS }, () => []);
  const full = LOOK.skidFull - LOOK.skidFrom;
  drive.car.wheels.forEach((place, k) => {
    const slip = drive.wheels[k].slip_mps;
    let line = null, drawn = -1;
    for (let i = first; i <= moment.i; i += every) {
      const part = (slip[i] - LOOK.skidFrom) / full;
      const level = part < 0 ? -1 : Math.min(Math.floor(part * SKID_LEVELS), SKID_LEVELS - 1);
      const pose = { x: drive.x_m[i], y: drive.y_m[i], heading: drive.heading_rad[i] };
      const at = level >= 0 || line ? onFloor(pose, place.x_m, place.y_m) : null;
      if (line) line.push(at);
      if (level !== drawn) {
        line = level >= 0 ? [at] : null;
        if (line) levels[level].push(line);
        drawn = level;
      }
    }
  });
  levels.forEach((lines, level) => {
    pen.begin();
    for (const line of lines) pen.through(line);
    const dark = SKID_FAINTEST
      + (LOOK.skidDarkest - SKID_FAINTEST) * level / (SKID_LEVELS - 1);
    pen.stroke(theme.colour("skid"), {
      wide: 1.5, metres: drive.car.wheels[2].width_m * 0.9, alpha: dark, cap: "butt",
    });
  });
}

/** The last reading of each sonar: an arc over its cone, or a faint cone where nothing echoed. */
export function drawSonar(pen, drive, moment, theme) {
  const colour = theme.colour("sonar");
  for (const sonar of drive.sonar) {
    const reading = indexAt(sonar.time_s, moment.t);
    if (reading < 0) continue;
    const echo = sonar.distance_m[reading], heard = Number.isFinite(echo);
    const [x, y] = onFloor(moment, sonar.x_m, sonar.y_m);
    const middle = moment.heading + sonar.angle_deg * DEGREES;
    const half = sonar.half_angle_deg * DEGREES, reach = heard ? echo : 3 * drive.car.length_m;
    pen.begin().move(x, y).arc(x, y, reach, middle - half, middle + half)
      .fill(colour, heard ? 0.12 : 0.05);
    if (!heard) continue;
    pen.begin().arc(x, y, echo, middle - half, middle + half)
      .stroke(colour, { wide: 2, alpha: 0.9 });
  }
}

/** A bar of a round length, from above only: in perspective a pixel has no one length. */
export function drawScaleBar(pen, theme, size) {
  if (pen.camera.perspective) return;
  const c = pen.context, { scale } = pen.camera, metres = niceStep(52 / scale);
  const right = size.width - 14, y = size.height - size.foot - 2, length = metres * scale;
  c.strokeStyle = c.fillStyle = theme.colour("soft");
  c.lineWidth = 1.5;
  c.beginPath();
  c.moveTo(right - length, y - 4); c.lineTo(right - length, y);
  c.lineTo(right, y); c.lineTo(right, y - 4);
  c.stroke();
  c.font = theme.font(11.5);
  c.textAlign = "center"; c.textBaseline = "alphabetic";
  c.fillText(`${tickLabel(metres)} m`, clamp(right - length / 2, 0, right - 16), y - 6);
}
