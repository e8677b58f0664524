// Friction painted on the floor: discs under the pointer, or under a brush that keys move.

import { signed } from "../viewer/numbers.js";
import * as say from "./messages.js";

const MOST = 16;  // patches, as the server allows

export class Brush {
  constructor({ factor, size, factorValue, sizeValue, toggle, undo, clear, count }, send) {
    Object.assign(this, { factor, size, toggle, count, send, patches: [], on: false, at: null });
    const show = () => {
      factorValue.textContent = `${signed(Number(factor.value), 2)} ×`;
      sizeValue.textContent = `${signed(Number(size.value), 2)} m`;
    };
    for (const input of [factor, size]) input.addEventListener("input", show);
    show();
    toggle.addEventListener("click", () => this.use(!this.on));
    undo.addEventListener("click", () => this.put(this.patches.slice(0, -1)));
    clear.addEventListener("click", () => this.put([]));
  }

  /** Whether the pointer paints, rather than moves the view. */
  use(on) {
    this.on = on;
    this.toggle.setAttribute("aria-pressed", on);
    if (!on) this.at = null;
  }

  take(patches) {
    this.patches = patches;
    this.count.textContent = `${patches.length} of ${MOST} patches. The friction of each is times`
      + " that of the tyres; it holds for simulated drives.";
  }

  put(patches) {
    this.take(patches);
    this.send(say.paint({ patches }));
  }

  /** Paint at a point of the floor (m); a stroke has a disc at each half radius. */
  paint(x, y) {
    const radius = Number(this.size.value), last = this.patches.at(-1);
    const full = this.patches.length >= MOST;
    if (full || last && Math.hypot(last.x_m - x, last.y_m - y) < radius / 2) return;
    this.put([...this.patches,
      { x_m: x, y_m: y, radius_m: radius, friction: Number(this.factor.value) }]);
  }

  /** Move the brush that is shown for the keyboard, from `start` on; Enter paints. */
  key(name, start) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (name === "Enter" && this.at) this.paint(...this.at);
    else if (step[name]) {
      const by = Number(this.size.value) / 2, [x, y] = this.at ?? start;
      this.at = [x + by * step[name][0], y + by * step[name][1]];
    } else return false;
    return true;
  }

  /** What the stage draws: the patches, and the brush where keys have moved it. */
  shown() {
    if (!this.at) return this.patches;
    const [x_m, y_m] = this.at;
    return [...this.patches, { x_m, y_m, radius_m: Number(this.size.value), friction: 2 }];
  }
}
