// Curves of an engine's statistics over time.

import { make } from "./dom.js";
import { duration, grouped, short } from "./numbers.js";

const CURVES = [
  ["steps_per_second", "Steps per second", grouped],
  ["episodes", "Episodes", grouped],
  ["mean_return", "Mean return", short],
  ["mean_length", "Mean length", (value) => short(value, 1)],
  ["success_rate", "Success rate", (value) => `${Math.round(100 * value)} %`],
];
const WIDTH = 300;
const HEIGHT = 100;

/** Number of points that the page keeps, one per second. */
const MAX_POINTS = 3600;

export class Curves {
  constructor(parent) {
    this.points = [];
    this.shown = CURVES.map(([key, title, text]) => {
      const figure = make("figure");
      figure.innerHTML = `<figcaption><span></span><b></b></figcaption>
        <svg viewBox="0 0 ${WIDTH} ${HEIGHT}" preserveAspectRatio="none" role="img"><path></path></svg>
        <small><span class="from"></span><span class="limits"></span><span class="to"></span></small>`;
      figure.querySelector("span").textContent = title;
      figure.querySelector("svg").setAttribute("aria-label", `${title} over time`);
      parent.append(figure);
      return { key, text, figure };
    });
  }

  /** Removes all points, when another engine is shown. */
  clear() {
    this.points = [];
    this.#draw();
  }

  add(points) {
    this.points = [...this.points, ...points].slice(-MAX_POINTS);
    this.#draw();
  }

  #draw() {
    for (const { key, text, figure } of this.shown) {
      const points = this.points.filter((point) => point[key] !== null);
      const last = points.at(-1);
      figure.querySelector("b").textContent = last ? text(last[key]) : "–";
      const values = points.map((point) => point[key]);
      const [least, most] = [Math.min(...values), Math.max(...values)];
      const [begin, end] = [points[0]?.seconds ?? 0, last?.seconds ?? 0];
      const x = (point) => (end > begin ? ((point.seconds - begin) / (end - begin)) * WIDTH : 0);
      const y = (point) => (most > least ? 4 + (1 - (point[key] - least) / (most - least)) * (HEIGHT - 8) : HEIGHT / 2);
      const line = points.map((point, i) => `${i === 0 ? "M" : "L"}${x(point).toFixed(1)} ${y(point).toFixed(1)}`);
      figure.querySelector("path").setAttribute("d", line.join(""));
      figure.querySelector(".from").textContent = last ? duration(begin) : "";
      figure.querySelector(".limits").textContent = last ? `${text(least)} to ${text(most)}` : "no data yet";
      figure.querySelector(".to").textContent = last ? duration(end) : "";
    }
  }
}
