// A drive: its series, and the car at any moment.
// Metres, x to the right and y up; angles positive to the left (ISO 8855), as in the data.

import { DEGREES, clamp, largestOf } from "./numbers.js";

/** The series in an object as `report.py` packs it: differences in whole steps, 0 is unknown. */
function unpack({ packed, step }) {
  const bytes = atob(packed), values = [];
  let code = 0, place = 1, total = 0;
  for (let i = 0; i < bytes.length; i++) {
    const byte = bytes.charCodeAt(i);
    code += (byte & 127) * place;
    place *= 128;
    if (byte & 128) continue;
    if (code > 0) total += code % 2 ? (code - 1) / 2 : -code / 2;
    values.push(code > 0 ? total * step : NaN);
    code = 0;
    place = 1;
  }
  return values;
}

/** The same data with every packed series as an array of numbers. */
export function unpacked(data) {
  if (Array.isArray(data)) return data.map(unpacked);
  if (data === null || typeof data !== "object") return data;
  if ("packed" in data) return unpack(data);
  return Object.fromEntries(Object.entries(data).map(([name, part]) => [name, unpacked(part)]));
}

/** Index of the last entry of the rising `series` that is at or before `t`, or -1. */
export function indexAt(series, t) {
  let low = -1, high = series.length;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (series[middle] <= t) low = middle; else high = middle;
  }
  return low;
}

/** Where `t` is in the rising `series`: the samples before and after, and the part between. */
function between(series, t) {
  const last = series.length - 1;
  const i = clamp(indexAt(series, t), 0, Math.max(last - 1, 0)), j = Math.min(i + 1, last);
  const wide = series[j] - series[i];
  return { i, j, part: wide > 0 ? clamp((t - series[i]) / wide, 0, 1) : 0 };
}

function blend(values, { i, j, part }) {
  if (!values) return NaN;
  return part === 0 ? values[i] : values[i] + (values[j] - values[i]) * part;
}

/** A column of a drive where its rising column `axis` is `at`. */
export const valueAt = (drive, name, at, axis = "time_s") =>
  blend(drive[name], between(drive[axis], at));

/** The motion in a table (a drive or its estimate) at time `t`, between samples. */
export function momentAt(drive, t) {
  const at = between(drive.time_s, t), read = (name) => blend(drive[name], at);
  const steering = read("steering_deg");
  const asked = Number.isFinite(steering) ? steering : read("steering_command_deg");
  const heading = drive.heading_rad?.[at.i] ?? NaN;
  const turned = (drive.heading_rad?.[at.j] ?? NaN) - heading;
  const way = drive.x_m ? Math.cos(heading) * (drive.x_m[at.j] - drive.x_m[at.i])
    + Math.sin(heading) * (drive.y_m[at.j] - drive.y_m[at.i]) : 0;
  return {
    // Sideslip is 0 backwards, so it does not tell where a car goes that reverses.
    backwards: way < 0 && read("sideslip_deg") === 0,
    i: at.i, t, x: read("x_m"), y: read("y_m"),
    // The heading may jump by a full turn from one sample to the next.
    heading: heading + at.part * Math.atan2(Math.sin(turned), Math.cos(turned)),
    speed: read("speed_mps"), sideslip: read("sideslip_deg"), yawRate: read("yaw_rate_degps"),
    steering: asked, throttle: read("throttle"), voltage: read("battery_v"),
    commandedSpeed: read("commanded_speed_mps"),
    wheels: (drive.wheels ?? []).map((wheel) => ({
      angle: blend(wheel.angle_rad, at), forceX: blend(wheel.force_x_n, at),
      forceY: blend(wheel.force_y_n, at), limit: blend(wheel.limit_n, at),
    })),
  };
}

/** The angle of a wheel to the car (rad). */
export const wheelAngle = (moment, k) =>
  moment.wheels[k]?.angle ?? (k < 2 && Number.isFinite(moment.steering)
    ? moment.steering * DEGREES : 0);

/** Where the point (x, y) of the car is on the floor while the car is at `pose`. */
export function onFloor(pose, x, y) {
  const c = Math.cos(pose.heading), s = Math.sin(pose.heading);
  return [pose.x + c * x - s * y, pose.y + s * x + c * y];
}

export const hasPath = (drive) => Boolean(drive.x_m);
export const hasWheels = (drive) => drive.wheels?.length > 0;
export const beginOf = (drive) => drive.time_s[0];
export const endOf = (drive) => drive.time_s[drive.time_s.length - 1];

/** The moment worth looking at first: the largest sideslip at speed (crawling has any angle). */
export function startingTime(drive) {
  const slip = drive.sideslip_deg;
  if (!slip) return beginOf(drive);
  const crawl = 0.25 * largestOf(drive.speed_mps);
  let best = 0, most = 0;
  for (let i = 1; i < slip.length; i++) {
    if (drive.speed_mps[i] > crawl && Math.abs(slip[i]) > most) {
      best = i;
      most = Math.abs(slip[i]);
    }
  }
  return drive.time_s[best];
}

/** The part of the floor that holds the walls and the paths of these drives, with a margin. */
export function boundsOf(drives) {
  let [left, low, right, high] = [Infinity, Infinity, -Infinity, -Infinity];
  const include = (x, y, margin) => {
    left = Math.min(left, x - margin); right = Math.max(right, x + margin);
    low = Math.min(low, y - margin); high = Math.max(high, y + margin);
  };
  const length = drives[0].car.length_m;
  for (const drive of drives) {
    for (const [x0, y0, x1, y1] of drive.walls_m) { include(x0, y0, 0); include(x1, y1, 0); }
    drive.x_m?.forEach((x, i) => include(x, drive.y_m[i], length * 0.6));
  }
  if (left > right) include(0, 0, length);
  const margin = length * 0.35;
  return { left: left - margin, low: low - margin, right: right + margin, high: high + margin };
}

/** The largest friction limit of any wheel (N), which forces are drawn in parts of. */
export const largestLimit = (drive) =>
  (drive.wheels ?? []).reduce((most, wheel) => Math.max(most, largestOf(wheel.limit_n)), 1e-9);

/** The events (faults, losses, …) of a drive that are under way at time `t`. */
export const eventsAt = (drive, t) =>
  (drive.events ?? []).filter((event) => event.from_s <= t && t < event.to_s);
