// Many self-playing environments on one canvas.

import { Pace } from "./pace.js";

const $ = (id) => document.getElementById(id);

/** Milliseconds per animation frame that steps may take, so that the page keeps 60 frames per second. */
const BUDGET = 10;

export class Wall {
  /** Calls `changed(wall)` when a wall starts, and `play(id)` when the user clicks one of its environments. */
  constructor(engine, specs, { changed, play, report }) {
    this.engine = engine;
    this.specs = specs;
    this.changed = changed;
    this.play = play;
    this.report = report;
    this.pace = new Pace(25, (count) => this.#steps(count));
    $("wall-pause").addEventListener("click", () => (this.pace.running ? this.stop() : this.resume()));
    $("wall-pace").addEventListener("input", () => {
      const pace = Number($("wall-pace").value);
      if (pace > 0) this.pace.stepsPerSecond = pace;
    });
    for (const control of ["wall-count", "wall-by"]) {
      $(control).addEventListener("change", () => this.start({ wall: this.id, count: $("wall-count").value, by: $("wall-by").value }));
    }
    $("picture").addEventListener("click", (event) => this.#choose(event));
  }

  /** Starts a wall of the environment `wall`, or of all of them. */
  start({ wall, count, by }) {
    const ids = wall === "all" ? this.specs.filter((spec) => spec.frame).map((spec) => spec.id) : [wall];
    const options = [...$("wall-count").options].map((option) => option.value);
    const number = options.includes(count) ? Number(count) : 100;
    const hasExpert = this.specs.some((spec) => ids.includes(spec.id) && spec.has_expert);
    const expert = by !== "random" && hasExpert;
    $("wall-count").value = String(number);
    $("wall-by").disabled = !hasExpert;
    $("wall-by").value = expert ? "expert" : "random";
    const groups = ids.map((id) => ({ id, num_envs: Math.max(1, Math.floor(number / ids.length)), options: {} }));
    const columns = number > 100 ? 25 : 10;
    try {
      this.state = this.engine.request({ wall: { groups, columns, expert, seed: "0" } });
    } catch (error) {
      return this.report(error);
    }
    this.id = wall;
    this.number = groups.reduce((sum, group) => sum + group.num_envs, 0);
    this.changed({ wall, count: String(number), by: expert ? "expert" : "random" });
    Object.assign($("picture"), { width: this.state.width, height: this.state.height });
    this.resume();
  }

  resume() {
    if (!this.state) return;
    this.since = { time: performance.now(), steps: 0 };
    this.pace.start();
    $("wall-pause").textContent = "Pause";
  }

  stop() {
    this.pace.stop();
    $("wall-pause").textContent = "Continue";
  }

  #steps(count) {
    try {
      const start = performance.now();
      for (let step = 0; step < count && (step === 0 || performance.now() - start < BUDGET); step += 1) {
        this.state = this.engine.stepWall(1);
        this.since.steps += this.number;
      }
      const picture = this.engine.wall(this.state.width, this.state.height);
      $("picture").getContext("2d").putImageData(picture, 0, 0);
    } catch (error) {
      this.stop();
      return this.report(error);
    }
    const seconds = (performance.now() - this.since.time) / 1000;
    if (seconds < 0.5) return;
    const rate = Math.round(this.since.steps / seconds).toLocaleString("en");
    $("wall-status").textContent = `${rate} steps per second. A click on an environment plays it.`;
    this.#table();
    this.since = { time: performance.now(), steps: 0 };
  }

  #table() {
    const number = (value) => (value === null ? "–" : value.toFixed(2));
    $("wall-table").replaceChildren(...this.state.groups.map((group) => {
      const row = document.createElement("tr");
      const cells = [group.id, group.episodes, number(group.mean_return), number(group.mean_length)];
      row.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
      return row;
    }));
  }

  #choose(event) {
    if (!this.state) return;
    const { left, top, width, height } = event.target.getBoundingClientRect();
    const rows = Math.ceil(this.number / this.state.columns);
    const column = Math.floor(((event.clientX - left) / width) * this.state.columns);
    let number = Math.floor(((event.clientY - top) / height) * rows) * this.state.columns + column;
    for (const group of this.state.groups) {
      if (number < group.num_envs) return this.play(group.id);
      number -= group.num_envs;
    }
  }
}
