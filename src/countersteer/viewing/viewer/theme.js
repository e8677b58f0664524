// Colours, from the page's custom properties: they follow light and dark.

const RAMP_STEPS = 24;

/** A colour of the palette by its name, and the two ramps. `read` follows a change of theme. */
export class Theme {
  constructor(rampEnd) {
    this.rampEnd = rampEnd;  // ° of sideslip
    this.family = getComputedStyle(document.body).fontFamily;
    this.read();
  }

  read() {
    this.style = getComputedStyle(document.documentElement);
    this.known = new Map();
    const stops = ["slip-low", "slip-mid", "slip-high"].map((name) =>
      [1, 3, 5].map((at) => parseInt(this.colour(name).slice(at, at + 2), 16)));
    this.ramp = Array.from({ length: RAMP_STEPS }, (_, step) => {
      const place = step / (RAMP_STEPS - 1) * 2, from = Math.min(Math.floor(place), 1);
      const mixed = stops[from].map((low, k) => low + (stops[from + 1][k] - low) * (place - from));
      return `rgb(${mixed.map(Math.round).join(" ")})`;
    });
  }

  colour(name) {
    if (!this.known.has(name)) {
      this.known.set(name, this.style.getPropertyValue("--" + name).trim());
    }
    return this.known.get(name);
  }

  /** Which colour of the ramp a sideslip (°) has. */
  slipStep(sideslip) {
    const part = Math.abs(sideslip || 0) / this.rampEnd;
    return Math.min(Math.floor(part * RAMP_STEPS), RAMP_STEPS - 1);
  }

  slip(sideslip) { return this.ramp[this.slipStep(sideslip)]; }

  run(k) { return this.colour(`run-${k + 1}`); }

  font(size, weight = 400) { return `${weight} ${size}px ${this.family}`; }
}
