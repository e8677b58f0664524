// Numbers and how they are written.

export const DEGREES = Math.PI / 180;

export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** The largest magnitude in a series, passing over unknown values. */
export function largestOf(series) {
  let most = 0;
  for (const value of series) if (Math.abs(value) > most) most = Math.abs(value);
  return most;
}

/** 1, 2 or 5 times a power of ten: the smallest that is at least `least`. */
export function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least * 0.9999);
}

/** The round numbers from `low` to `high`, at least `leastStep` apart. */
export function ticksBetween(low, high, leastStep) {
  const step = niceStep(leastStep), ticks = [];
  const first = Math.ceil(low / step - 1e-9), end = Math.floor(high / step + 1e-9);
  for (let k = first; k <= end; k++) ticks.push(k * step);
  return ticks;
}

/** A number with so many digits and a proper minus; a dash if it is unknown. */
export function signed(value, digits) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(digits);
  return (value < 0 && Number(text) !== 0 ? "−" : "") + text;
}

/** A round number as the label of an axis. */
export const tickLabel = (value) => String(+value.toFixed(6)).replace("-", "−");
