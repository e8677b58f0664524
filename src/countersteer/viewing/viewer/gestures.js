// Wheel, pinch and drag on an element, as zooms and pans in its pixels.

const WHEEL = 0.0016;  // of the zoom's logarithm, per pixel of a wheel
const LINE = 16;  // px, where a wheel counts in lines

/**
 * `zoom(factor, x, y)`, `pan(dx, dy)`, `drag(x, y)` and `reset()` answer; those that are missing do
 * nothing. `drag` takes the place of `pan` for one pointer. A plain wheel zooms only if
 * `plainWheel`; else it scrolls the page, and zooms with Ctrl, as a pinch on a touchpad does.
 */
export function onGestures(element, { zoom, pan, drag, reset }, plainWheel) {
  const down = new Map();
  const place = (event) => {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const spread = ([a, b]) => ({
    x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, apart: Math.hypot(a[0] - b[0], a[1] - b[1]),
  });

  element.addEventListener("wheel", (event) => {
    const unit = event.deltaMode === 1 ? LINE : 1;
    const sideways = Math.abs(event.deltaX) > Math.abs(event.deltaY);
    if (!plainWheel && !event.ctrlKey && !sideways) return;
    event.preventDefault();
    if (sideways && !event.ctrlKey) { pan?.(-event.deltaX * unit, 0); return; }
    // A touchpad's pinch comes as a wheel with Ctrl and small numbers.
    const strength = event.ctrlKey ? 6 * WHEEL : WHEEL;
    zoom?.(Math.exp(-event.deltaY * unit * strength), ...place(event));
  }, { passive: false });

  element.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    element.setPointerCapture(event.pointerId);
    down.set(event.pointerId, place(event));
    if (down.size === 1) drag?.(...place(event));
  });
  element.addEventListener("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    const before = [...down.values()], old = down.get(event.pointerId), now = place(event);
    down.set(event.pointerId, now);
    if (down.size === 1) {
      if (drag) drag(...now);
      else pan?.(now[0] - old[0], now[1] - old[1]);
    } else if (down.size === 2) {
      const was = spread(before), is = spread([...down.values()]);
      pan?.(is.x - was.x, is.y - was.y);
      if (was.apart > 0 && is.apart > 0) zoom?.(is.apart / was.apart, is.x, is.y);
    }
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    element.addEventListener(name, (event) => down.delete(event.pointerId));
  }
  element.addEventListener("dblclick", () => reset?.());
}
