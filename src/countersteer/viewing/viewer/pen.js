// Draws lines, areas and texts that are given in metres of the world, through any camera.
// So each thing is drawn by one function, from above and in perspective.

const SHORT = 8;  // points of a piece of a line that has one width

/** A line in short pieces, each a group of its own. */
function shortPieces(line) {
  const pieces = [];
  for (let i = 0; i < line.length; i += SHORT) pieces.push([line.slice(i, i + SHORT + 1)]);
  return pieces;
}

/** A pen on a canvas context (CSS pixels) that looks through a camera. */
export class Pen {
  constructor(context, camera) {
    this.context = context;
    this.camera = camera;
    this.lines = [];
  }

  /** Forget the lines so far, and begin others. */
  begin() {
    this.lines = [];
    return this;
  }

  move(x, y, z = 0) {
    this.lines.push([this.camera.seen(x, y, z)]);
    return this;
  }

  to(x, y, z = 0) {
    if (!this.lines.length) return this.move(x, y, z);
    this.lines[this.lines.length - 1].push(this.camera.seen(x, y, z));
    return this;
  }

  /** One line through points (x, y[, z]). */
  through(points, z = 0) {
    points.forEach((point, i) => {
      const [x, y, up = z] = point;
      if (i) this.to(x, y, up); else this.move(x, y, up);
    });
    return this;
  }

  /** Part of a circle, from one angle to another (rad); it goes on from the last point. */
  arc(x, y, radius, from = 0, to = 2 * Math.PI, z = 0) {
    const count = Math.max(6, Math.ceil(Math.abs(to - from) / (2 * Math.PI) * 48));
    for (let k = 0; k <= count; k++) {
      const angle = from + (to - from) * k / count;
      this.to(x + radius * Math.cos(angle), y + radius * Math.sin(angle), z);
    }
    return this;
  }

  /** Stroke the lines, so many pixels wide, but at least so many metres. */
  stroke(colour, { wide = 1, metres = 0, alpha = 1, dash = [], cap = "round" } = {}) {
    const c = this.context, { camera } = this;
    c.strokeStyle = colour;
    c.globalAlpha = alpha;
    c.lineCap = cap;
    c.lineJoin = "round";
    c.setLineDash(dash);
    // In perspective, a line that is wide in metres is narrower farther away, piece by piece.
    const pieces = metres && camera.perspective;
    for (const lines of pieces ? this.lines.flatMap(shortPieces) : [this.lines]) {
      const depth = pieces ? lines[0][lines[0].length >> 1][2] : 1;
      if (pieces && depth < camera.near) continue;
      c.lineWidth = Math.max(wide, metres * camera.scaleAt(depth));
      c.beginPath();
      for (const line of lines) this.trace(line, false);
      c.stroke();
    }
    c.setLineDash([]);
    c.globalAlpha = 1;
    return this;
  }

  /** Fill the areas that the lines enclose. */
  fill(colour, alpha = 1) {
    const c = this.context;
    c.fillStyle = colour;
    c.globalAlpha = alpha;
    c.beginPath();
    for (const line of this.lines) this.trace(line, true);
    c.fill();
    c.globalAlpha = 1;
    return this;
  }

  /** Put a line on the context's path, without the parts behind the camera. */
  trace(line, closed) {
    const { context: c, camera } = this, near = camera.near ?? -Infinity;
    let before = closed ? line[line.length - 1] : null, down = false, atX = NaN, atY = NaN;
    const put = (point) => {
      const [x, y] = camera.pixel(...point);
      if (!down) c.moveTo(x, y);
      // Points closer than a part of a pixel cost time, and are not seen.
      else if (closed || Math.abs(x - atX) + Math.abs(y - atY) > 0.6) c.lineTo(x, y);
      else return;
      down = true;
      [atX, atY] = [x, y];
    };
    const cut = (a, b) => {
      const part = (near - a[2]) / (b[2] - a[2]);
      return [a[0] + (b[0] - a[0]) * part, a[1] + (b[1] - a[1]) * part, near];
    };
    line.forEach((point, i) => {
      const shows = point[2] > near, showed = before !== null && before[2] > near;
      if (before !== null && shows !== showed) put(cut(before, point));
      if (shows) put(point);
      else if (!closed) down = false;
      before = point;
      if (i === line.length - 1 && closed && down) c.closePath();
    });
  }

  /** Pixels of a point, or null behind the camera. */
  pixel(x, y, z = 0) {
    const seen = this.camera.seen(x, y, z);
    return seen[2] > (this.camera.near ?? -Infinity) ? this.camera.pixel(...seen) : null;
  }

  /** How far a point is from the camera. */
  depth(x, y, z = 0) { return this.camera.seen(x, y, z)[2]; }

  /** Metres that are as wide as a pixel, at a point. */
  metresPerPixel(x, y) { return 1 / this.camera.scaleAt(this.depth(x, y)); }

  /** A text at a point, with an edge in the colour `around` so that it reads on anything. */
  text(x, y, words, { font, colour, around, dx = 0, dy = 0, z = 0 }) {
    const at = this.pixel(x, y, z);
    if (!at) return;
    const c = this.context;
    Object.assign(c, {
      font, textAlign: "center", textBaseline: "middle", lineWidth: 4, strokeStyle: around,
      fillStyle: colour, lineJoin: "round",
    });
    c.strokeText(words, at[0] + dx, at[1] + dy);
    c.fillText(words, at[0] + dx, at[1] + dy);
  }

  /** An arrow on the floor; shorter than its head it is only a line. */
  arrow(x0, y0, x1, y1, colour, wide) {
    const length = Math.hypot(x1 - x0, y1 - y0), pixel = this.metresPerPixel(x0, y0);
    const head = 3.6 * wide * pixel;
    if (!(length >= pixel)) return;
    const along = [(x1 - x0) / length, (y1 - y0) / length], neck = Math.max(length - head, 0);
    this.begin().move(x0, y0).to(x0 + along[0] * neck, y0 + along[1] * neck)
      .stroke(colour, { wide });
    if (length < head) return;
    this.begin().move(x1, y1);
    for (const side of [-0.45, 0.45]) {
      this.to(x1 - head * (along[0] + side * along[1]), y1 - head * (along[1] - side * along[0]));
    }
    this.fill(colour);
  }
}
