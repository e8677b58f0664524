// Cameras: from above, and in perspective from behind the car.
// A camera turns a point of the world into (across, up, depth) of its own, and that into pixels.

import { DEGREES, clamp } from "./numbers.js";

const NEAR = 0.05;  // m, what is closer to the camera is not seen
const FIELD = 52 * DEGREES;  // of view, of the perspective, from top to bottom

/** Looks down on (x, y), which is in the middle, with so many pixels per metre. */
export class TopCamera {
  constructor(x, y, scale, size) {
    Object.assign(this, { x, y, scale, size, perspective: false });
  }

  /** Pixels per metre at the depth of a point. */
  scaleAt() { return this.scale; }

  seen(x, y) { return [x - this.x, y - this.y, 1]; }

  pixel(across, up) {
    return [this.size.width / 2 + across * this.scale, this.size.height / 2 - up * this.scale];
  }

  /** The point of the floor under a pixel. */
  floorAt(px, py) {
    return [this.x + (px - this.size.width / 2) / this.scale,
      this.y - (py - this.size.height / 2) / this.scale];
  }
}

/** Stands at `eye` (x, y, z) and looks along the angle `yaw` (rad), `pitch` below the horizon. */
export class ChaseCamera {
  constructor(eye, yaw, pitch, size) {
    Object.assign(this, { eye, size, perspective: true, near: NEAR });
    this.focal = size.height / 2 / Math.tan(FIELD / 2);
    const [c, s, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    this.right = [s, -c, 0];
    this.up = [c * sp, s * sp, cp];
    this.ahead = [c * cp, s * cp, -sp];
  }

  scaleAt(depth) { return this.focal / Math.max(depth, NEAR); }

  seen(x, y, z) {
    const from = [x - this.eye[0], y - this.eye[1], z - this.eye[2]];
    return [this.right, this.up, this.ahead].map((axis) =>
      axis[0] * from[0] + axis[1] * from[1] + axis[2] * from[2]);
  }

  pixel(across, up, depth) {
    return [this.size.width / 2 + this.focal * across / depth,
      this.size.height / 2 - this.focal * up / depth];
  }
}

/**
 * What the viewer asks of the camera: `follow` the car, the whole `course`, or `chase` it.
 */
export class CameraRig {
  constructor(mode = "follow") {
    Object.assign(this, { mode, lengths: 4.8 });  // of the car, that are seen around it
    this.reset();
  }

  /** Show this, without zoom and shift. */
  choose(mode) {
    this.mode = mode;
    this.reset();
  }

  reset() { Object.assign(this, { zoom: 1, x: 0, y: 0, yaw: 0, pitch: 0 }); }

  /** The camera for a car at `moment`; `margin` is what controls cover above and below (px). */
  camera(moment, bounds, car, size, margin, chase) {
    this.last = this.mode === "chase" ? this.behind(chase, car, size)
      : this.above(moment, bounds, car, size, margin);
    return this.last;
  }

  above(moment, bounds, car, size, margin) {
    const wide = bounds.right - bounds.left, tall = bounds.high - bounds.low;
    const room = Math.max(size.height - margin.above - margin.below, 20);
    const whole = Math.min(size.width / wide, room / tall);
    const centre = (margin.above - margin.below) / 2;
    if (this.mode === "course" || !Number.isFinite(moment.x)) {
      const scale = whole * this.zoom;
      return new TopCamera((bounds.left + bounds.right) / 2 + this.x,
        (bounds.low + bounds.high) / 2 + centre / whole + this.y, scale, size);
    }
    const scale = Math.max(whole, Math.min(size.width, size.height) / (this.lengths * car.length_m))
      * this.zoom;
    // The camera stops at the edge of the course, as there is nothing to see beyond it.
    const stop = (at, low, high, half) =>
      high - low <= 2 * half ? (low + high) / 2 : clamp(at, low + half, high - half);
    return new TopCamera(
      stop(moment.x, bounds.left, bounds.right, size.width / 2 / scale) + this.x,
      stop(moment.y, bounds.low - margin.below / scale, bounds.high + margin.above / scale,
        size.height / 2 / scale) + this.y, scale, size);
  }

  /** Behind a car that goes along `chase.yaw`, and above it. */
  behind(chase, car, size) {
    const away = 5.2 * car.length_m / this.zoom, yaw = chase.yaw + this.yaw;
    const pitch = clamp(24 * DEGREES + this.pitch, 4 * DEGREES, 85 * DEGREES);
    const flat = away * Math.cos(pitch), ahead = 0.7 * car.length_m;
    const eye = [chase.x + (ahead - flat) * Math.cos(yaw), chase.y + (ahead - flat) * Math.sin(yaw),
      away * Math.sin(pitch) + 0.2 * car.length_m];
    return new ChaseCamera(eye, yaw, pitch, size);
  }

  /** Zoom by a factor; from above, the point of the floor under (px, py) stays there. */
  zoomBy(factor, px, py) {
    const before = this.zoom;
    this.zoom = clamp(this.zoom * factor, 0.2, 30);
    const camera = this.last;
    if (!camera || camera.perspective || px === undefined) return;
    const [x, y] = camera.floorAt(px, py), part = 1 - before / this.zoom;
    this.x += (x - camera.x) * part;
    this.y += (y - camera.y) * part;
  }

  /** Drag by so many pixels: the floor comes along, or the camera goes round the car. */
  panBy(dx, dy) {
    if (this.last?.perspective) {
      this.yaw -= dx * 0.006;
      this.pitch = clamp(this.pitch + dy * 0.006, -20 * DEGREES, 61 * DEGREES);
    } else if (this.last) {
      this.x -= dx / this.last.scale;
      this.y += dy / this.last.scale;
    }
  }
}
