// The view of the car on its course: a canvas, a camera, and layers that can be switched off.

import { drawCar, drawGhost } from "./car.js";
import { CameraRig, TopCamera } from "./camera.js";
import { beginOf, boundsOf, hasPath, largestLimit, momentAt } from "./drive.js";
import {
  drawDrivenPath, drawGoal, drawGrid, drawPatches, drawScaleBar, drawSkids, drawSonar, drawWalls,
  drawWholePath,
} from "./floor.js";
import { largestOf } from "./numbers.js";
import {
  drawEstimate, drawForces, drawGhosts, drawRollouts, drawSideslip, drawSideslipLabel,
  drawVelocity,
} from "./overlays.js";
import { Pen } from "./pen.js";

const CHASED = 0.45, LOOKS = 9;  // s of the past whose mean heading the camera has, in so many looks

const NARROW_STAGE = 480;  // px

export class Stage {
  /** Of drives on one floor. `layers` says by name what is shown; its owner may change it. */
  constructor(canvas, drives, theme, layers) {
    Object.assign(this, { canvas, drives, theme, layers, rig: new CameraRig() });
    this.context = canvas.getContext("2d");
    this.size = { width: 0, height: 0, ratio: 1, head: 0, foot: 0 };
    this.mapOnLeft = false;
    this.companions = [];  // other drives that are only outlined, from the same start of the clock
    this.patches = [];  // of other friction on the floor
    this.goal = null;  // its line
    this.measure();
  }

  /** What follows from the whole of the drives. Call it again when they have grown. */
  measure() {
    this.shown = this.drives.filter(hasPath);
    this.bounds = boundsOf(this.drives);
    const courses = new Map(this.drives.map((one) => [JSON.stringify(one.walls_m), one.walls_m]));
    this.walls = [...courses.values()].flat();
    this.fastest = this.shown.reduce((most, one) => Math.max(most, largestOf(one.speed_mps ?? [])), 0);
    this.limit = this.drives.reduce((most, one) => Math.max(most, largestLimit(one)), 1e-9);
  }

  /** Take the canvas's size on the page; `head` and `foot` (px) are covered by controls. */
  fit(head, foot) {
    const box = this.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    this.size = { width: box.width, height: box.height, ratio, head, foot };
    this.canvas.width = Math.round(box.width * ratio);
    this.canvas.height = Math.round(box.height * ratio);
  }

  /** Draw the drives at these moments; the camera is with number `focus`. */
  draw(moments, focus) {
    const { context: c, size, theme, layers, rig } = this, drive = this.drives[focus];
    const moment = moments[focus], alone = this.drives.length === 1;
    c.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
    c.clearRect(0, 0, size.width, size.height);
    if (!hasPath(drive)) return;
    const margin = { above: size.head, below: size.foot + 18 };
    const chase = rig.mode === "chase" ? chased(drive, moment) : null;
    const camera = rig.camera(moment, this.bounds, drive.car, size, margin, chase);
    const pen = new Pen(c, camera);
    drawGrid(pen, theme, size, moment, drive.car);
    drawPatches(pen, this.patches, theme);
    if (this.goal) drawGoal(pen, this.goal, theme);
    this.drives.forEach((one, k) => {
      if (!hasPath(one)) return;
      drawWholePath(pen, one, alone ? theme.colour("soft") : theme.run(k));
      if (layers.skids && k === focus) drawSkids(pen, one, moments[k], theme);
      drawDrivenPath(pen, one, moments[k], theme, alone ? null : theme.run(k));
    });
    drawWalls(pen, this.walls, theme, drive.car);
    if (layers.rollouts && drive.rollouts?.length) drawRollouts(pen, drive, moment, theme);
    if (layers.sonar) drawSonar(pen, drive, moment, theme);
    if (layers.ghosts && alone) drawGhosts(pen, drive, moment, theme);
    this.companions.forEach((one, k) => {
      drawWholePath(pen, one, theme.run(k + 1));
      drawGhost(pen, one.car, momentAt(one, beginOf(one) + moment.t), theme.run(k + 1), 1);
    });
    if (layers.estimate) drawEstimate(pen, drive, moment, theme);
    this.drives.forEach((one, k) => {
      if (k !== focus && hasPath(one)) drawCar(pen, one.car, moments[k], theme, theme.run(k));
    });
    drawSideslip(pen, drive, moment, theme, this.fastest);
    drawCar(pen, drive.car, moment, theme, alone ? theme.slip(moment.sideslip) : theme.run(focus));
    if (layers.forces) drawForces(pen, drive, moment, theme, this.limit);
    drawVelocity(pen, drive, moment, theme, this.fastest);
    drawSideslipLabel(pen, drive, moment, theme, this.fastest);
    drawScaleBar(pen, theme, size);
    if (rig.mode !== "course") this.drawMap(moments, focus, camera);
  }

  /** The whole course, small, when only a part of it is in view. */
  drawMap(moments, focus, camera) {
    const { context: c, size, theme, bounds } = this;
    const wide = bounds.right - bounds.left, tall = bounds.high - bounds.low;
    const hides = camera.perspective || camera.scale * tall > 1.25 * size.height
      || camera.scale * wide > 1.25 * size.width;
    if (!hides) return;
    const part = size.width < NARROW_STAGE ? 0.19 : 0.25;
    const scale = Math.min(size.width, size.height) * part / Math.max(wide, tall);
    // The map makes way for the car, and stays where it is as long as it can.
    const at = camera.perspective ? 0
      : camera.pixel(moments[focus].x - camera.x, moments[focus].y - camera.y)[0];
    const clear = wide * scale + 130;
    if (at > size.width - clear) this.mapOnLeft = true;
    else if (at < clear) this.mapOnLeft = false;
    const left = this.mapOnLeft ? 34 : size.width - 14 - wide * scale;
    const top = size.height - size.foot - 34 - tall * scale;
    c.save();
    c.beginPath();
    c.roundRect(left, top, wide * scale, tall * scale, 8);
    c.fillStyle = theme.colour("card");
    c.strokeStyle = theme.colour("line");
    c.globalAlpha = 0.88; c.fill();
    c.globalAlpha = 1; c.lineWidth = 1; c.stroke();
    c.translate(left, top);
    const small = new TopCamera((bounds.left + bounds.right) / 2, (bounds.low + bounds.high) / 2,
      scale, { width: wide * scale, height: tall * scale });
    const pen = new Pen(c, small);
    drawWholePath(pen, this.drives[focus], theme.colour("soft"), 0.7);
    pen.begin();
    for (const [x0, y0, x1, y1] of this.walls) pen.move(x0, y0).to(x1, y1);
    pen.stroke(theme.colour("wall"), { wide: 1.5 });
    this.drives.forEach((one, k) => {
      if (!hasPath(one)) return;
      pen.begin().arc(moments[k].x, moments[k].y, 4 / scale)
        .fill(this.drives.length > 1 ? theme.run(k) : theme.colour("velocity"));
    });
    c.restore();
  }
}

/** Where a camera behind the car looks: along the mean heading of the last moments. */
function chased(drive, moment) {
  let [c, s] = [0, 0];
  for (let k = 0; k < LOOKS; k++) {
    const { heading } = momentAt(drive, moment.t - CHASED * k / (LOOKS - 1));
    c += Math.cos(heading);
    s += Math.sin(heading);
  }
  return { x: moment.x, y: moment.y, yaw: Math.atan2(s, c) };
}
