// The clock of what is shown: plays from begin to end at a speed, and begins again.

import { clamp } from "./numbers.js";

const HOLD = 1;  // s that the end is shown for before the drive begins again
const LONGEST = 0.1;  // s of a frame; a page that was hidden for a while goes on where it was

export class Playback {
  /** `draw` is called once a frame in which something changed. */
  constructor(begin, end, draw) {
    Object.assign(this, { begin, end, draw, t: begin, playing: false, speed: 1, held: 0 });
    this.frame = 0;
    this.before = null;
  }

  goTo(t) {
    this.t = clamp(t, this.begin, this.end);
    this.held = 0;
    this.redraw();
  }

  play(playing) {
    this.playing = playing;
    if (playing && this.t >= this.end) this.goTo(this.begin);
    this.redraw();
  }

  redraw() {
    if (!this.frame) this.frame = requestAnimationFrame((now) => this.tick(now));
  }

  tick(now) {
    this.frame = 0;
    if (this.playing) {
      const passed = this.before === null ? 0 : Math.min((now - this.before) / 1000, LONGEST);
      if (this.t < this.end) this.t = Math.min(this.t + passed * this.speed, this.end);
      else if ((this.held += passed) > HOLD) { this.t = this.begin; this.held = 0; }
    }
    this.before = this.playing ? now : null;
    this.draw();
    if (this.playing) this.redraw();
  }
}
