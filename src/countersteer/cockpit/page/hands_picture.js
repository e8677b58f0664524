// A little picture of what hands do and what comes of it: keys, throttle, steering and yaw rate.

import { element } from "../viewer/elements.js";
import { clamp, signed } from "../viewer/numbers.js";

const LEFT = 118, WIDE = 180, MIDDLE = LEFT + WIDE / 2;  // of the tracks
const MOST_STEERING = 30, MOST_YAW = 300;  // ° and °/s at a track's end
const CAPS = [["up", 40, 8, "M0 5V-5M-4 -1L0 -5L4 -1"], ["left", 12, 36, "M5 0H-5M-1 -4L-5 0L-1 4"],
  ["down", 40, 36, "M0 -5V5M-4 1L0 5L4 1"], ["right", 68, 36, "M-5 0H5M1 -4L5 0L1 4"]];

const place = (value, most) => MIDDLE - clamp(value / most, -1, 1) * WIDE / 2;  // left is left
const set = (part, values) => {
  for (const [name, value] of Object.entries(values)) part.setAttribute(name, value);
};

/** Put the picture into a box; returns what shows the hands and a state. */
export function handsPicture(box) {
  const svg = element(box, "svg", { viewBox: "0 0 300 70", role: "img",
    "aria-label": "Keys held, steering and yaw rate" });
  const caps = CAPS.map(([way, x, y, arrow]) => {
    const cap = element(svg, "rect", { x, y, width: 25, height: 25, rx: 5, class: "key-cap" });
    element(svg, "path", { d: arrow, transform: `translate(${x + 12.5} ${y + 12.5})`,
      class: "arrow" });
    return [way, cap];
  });
  element(svg, "rect", { x: 100, y: 8, width: 7, height: 53, rx: 2, class: "track" });
  const push = element(svg, "rect", { x: 100, width: 7, rx: 2 });
  const track = (y, name) => {
    const words = element(svg, "text", { x: LEFT, y: y - 5 }, name);
    element(svg, "rect", { x: LEFT, y, width: WIDE, height: 8, rx: 3, class: "track" });
    const is = element(svg, "rect", { y, height: 8, class: "is" });
    element(svg, "path", { d: `M${MIDDLE} ${y - 2}v12`, class: "zero" });
    return { words, is, asked: element(svg, "rect", { y: y - 2.5, width: 5, height: 13, rx: 2,
      class: "asked" }) };
  };
  const steering = track(17, "steering"), yaw = track(52, "yaw rate");
  const show = ({ is, asked, words }, value, target, most, text) => {
    const at = place(value ?? 0, most);
    set(is, { x: Math.min(at, MIDDLE), width: Math.abs(at - MIDDLE) });
    asked.style.visibility = target === null ? "hidden" : "";
    if (target !== null) set(asked, { x: place(target, most) - 2.5 });
    words.textContent = text;
  };
  return (hands, state) => {
    const held = { up: hands.throttle > 0, down: hands.brake > 0, left: hands.steer > 0,
      right: hands.steer < 0 };
    for (const [way, cap] of caps) cap.classList.toggle("held", held[way]);
    const part = clamp(state.throttle ?? 0, -1, 1);
    set(push, { y: part < 0 ? 8 : 61 - 53 * part, height: 53 * Math.abs(part),
      class: part < 0 ? "brake" : "throttle" });
    const target = state.yaw_target_degps;
    show(steering, state.steering_deg, state.steering_command_deg, MOST_STEERING,
      `steering ${signed(state.steering_deg, 0)}°, asked ${signed(state.steering_command_deg, 0)}°`);
    show(yaw, state.yaw_rate_degps, target, MOST_YAW, `yaw rate ${signed(state.yaw_rate_degps, 0)}`
      + `${target === null ? "" : `, target ${signed(target, 0)}`} °/s`);
  };
}
