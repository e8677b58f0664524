// How well the page keeps up: pictures a second, what drawing costs, and from a hand to a picture.

const KEPT = 240;  // of each series

/** The middle of some numbers; NaN of none. */
export const median = (values) => {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted.length ? sorted[sorted.length >> 1] : NaN;
};

export class Meter {
  constructor() { Object.assign(this, { frames: [], costs: [], waits: [], pending: [] }); }

  keep(series, value) {
    series.push(value);
    if (series.length > KEPT) series.shift();
  }

  /** Hands have changed with input `seq` at `now` (ms). */
  moved(seq, now) { this.keep(this.pending, { seq, now }); }

  /** A picture of a state that has felt input `seq` was drawn from `begin` to `end` (ms). */
  drew(seq, begin, end) {
    this.keep(this.frames, begin);
    this.keep(this.costs, end - begin);
    for (const { now } of this.pending.filter((one) => one.seq <= seq)) this.keep(this.waits, end - now);
    this.pending = this.pending.filter((one) => one.seq > seq);
  }

  /** Pictures a second, over the last ones. */
  get rate() {
    const { frames } = this, recent = frames.slice(-60);
    return recent.length < 2 ? NaN : 1000 * (recent.length - 1) / (recent.at(-1) - recent[0]);
  }

  get cost() { return median(this.costs); }

  get wait() { return median(this.waits); }
}
