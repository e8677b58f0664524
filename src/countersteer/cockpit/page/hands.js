// What hands do, with keys, a gamepad or two thumbs, as three numbers: steer, throttle and brake.

import { clamp } from "../viewer/numbers.js";

const KEYS = {
  ArrowUp: "up", KeyW: "up", ArrowDown: "down", KeyS: "down",
  ArrowLeft: "left", KeyA: "left", ArrowRight: "right", KeyD: "right",
};
const DEAD = 0.12;  // part of a stick's way that means nothing
const STEER_STICK = 0, RIGHT_TRIGGER = 7, LEFT_TRIGGER = 6;  // of the standard gamepad

const curved = (value) => {
  const part = (Math.abs(value) - DEAD) / (1 - DEAD);
  return part > 0 ? Math.sign(value) * part : 0;
};

export class Hands {
  /**
   * `tell(changed)` is called at once when something was pressed, moved or let go, and each
   * `heartbeat` ms so that the server hears that the page is alive.
   */
  constructor(tell, heartbeat) {
    Object.assign(this, { held: new Set(), thumbs: { steer: 0, drive: 0 }, source: "keys" });
    this.changed = () => tell(true);
    this.before = "";
    setInterval(() => tell(false), heartbeat);
    addEventListener("keyup", (event) => this.release(event.code));
    addEventListener("blur", () => this.releaseAll());
    document.addEventListener("visibilitychange", () => this.releaseAll());
  }

  /** Whether a key drives the car; if so it is held from now on. */
  press(code) {
    const way = KEYS[code];
    if (!way) return false;
    this.source = "keys";
    if (!this.held.has(code)) {
      this.held.add(code);
      this.changed();
    }
    return true;
  }

  release(code) { if (this.held.delete(code)) this.changed(); }

  releaseAll() {
    this.held.clear();
    this.thumbs = { steer: 0, drive: 0 };
    this.changed();
  }

  holds(way) { return [...this.held].some((code) => KEYS[code] === way); }

  /** Two areas for thumbs: one from side to side, one up and down. */
  useThumbs(steerPad, drivePad) {
    const bind = (pad, name, read) => {
      const knob = pad.querySelector("i");
      const move = (event) => {
        const box = pad.getBoundingClientRect();
        const x = clamp((event.clientX - box.left) / box.width * 2 - 1, -1, 1);
        const y = clamp(1 - (event.clientY - box.top) / box.height * 2, -1, 1);
        this.source = "touch";
        this.thumbs[name] = curved(read(x, y));
        knob.style.translate = name === "steer" ? `${x * box.width * 0.36}px 0`
          : `0 ${-y * box.height * 0.36}px`;
        this.changed();
      };
      const end = () => {
        this.thumbs[name] = 0;
        knob.style.translate = "";
        this.changed();
      };
      pad.addEventListener("pointerdown", (event) => {
        pad.setPointerCapture(event.pointerId);
        move(event);
      });
      pad.addEventListener("pointermove", (event) => {
        if (pad.hasPointerCapture(event.pointerId)) move(event);
      });
      for (const name of ["pointerup", "pointercancel"]) pad.addEventListener(name, end);
    };
    bind(steerPad, "steer", (x) => -x);
    bind(drivePad, "drive", (x, y) => y);
  }

  /** The first gamepad that is touched takes over from keys and thumbs. */
  pad() {
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad?.connected || pad.mapping !== "standard") continue;
      const found = {
        steer: -curved(pad.axes[STEER_STICK]), throttle: pad.buttons[RIGHT_TRIGGER].value,
        brake: pad.buttons[LEFT_TRIGGER].value,
      };
      if (found.steer || found.throttle || found.brake) this.source = "pad";
      if (this.source === "pad") return found;
    }
    return null;
  }

  /** Look at the gamepad, which tells nothing by itself: once a frame. */
  poll() {
    const now = JSON.stringify(this.pad());
    if (now !== this.before) this.changed();
    this.before = now;
  }

  /** Steer (left is positive), throttle and brake now. */
  read() {
    const pad = this.pad();
    if (pad) return pad;
    const keys = (way) => (this.holds(way) ? 1 : 0);
    if (this.source !== "touch") {
      return { steer: keys("left") - keys("right"), throttle: keys("up"), brake: keys("down") };
    }
    const { steer, drive } = this.thumbs;
    return { steer, throttle: Math.max(drive, 0), brake: Math.max(-drive, 0) };
  }
}
