// Many self-playing environments on one canvas, which a worker steps and draws.

import { live } from "./live.js";

const $ = (id) => document.getElementById(id);

export class Wall {
  #worker = null;

  /** Steps of each environment per second; null before the first report. */
  rate = null;

  /** Calls `changed(wall)` when a wall starts, and `play(episode)` when the user clicks one of its environments. */
  constructor(engine, specs, { changed, play, report }) {
    Object.assign(this, { engine, specs, changed, play, report });
    this.say = live($("wall-status"));
    $("wall-pause").addEventListener("click", () => (this.running ? this.stop() : this.resume()));
    $("wall-pace").addEventListener("input", () => this.setPace(Number($("wall-pace").value)));
    for (const control of ["wall-count", "wall-by"]) {
      $(control).addEventListener("change", () => this.start({ ...this.link, count: $("wall-count").value, by: $("wall-by").value }));
    }
    $("picture").addEventListener("click", (event) => this.#choose(event));
  }

  /** Starts a wall of the environment `wall`, or of all of them. */
  start({ wall, count, by, options = {} }) {
    const ids = wall === "all" ? this.specs.filter((spec) => spec.frame || spec.picture).map((spec) => spec.id) : [wall];
    const counts = [...$("wall-count").options].map((option) => option.value);
    const number = counts.includes(count) ? Number(count) : 100;
    const hasExpert = this.specs.some((spec) => ids.includes(spec.id) && spec.has_expert);
    const expert = by !== "random" && hasExpert;
    $("wall-count").value = String(number);
    $("wall-by").disabled = !hasExpert;
    $("wall-by").value = expert ? "expert" : "random";
    const groups = ids.map((id) => ({ id, num_envs: Math.max(1, Math.floor(number / ids.length)), options }));
    this.state = null;
    this.link = { wall, count: String(number), by: expert ? "expert" : "random", options };
    this.#send("start", { request: { groups, columns: number > 100 ? 25 : 10, expert, seed: "0" } });
    this.#running(true);
  }

  resume() {
    if (!this.link) return;
    this.#send("run", { running: true });
    this.#running(true);
  }

  stop() {
    if (this.#worker) this.#send("run", { running: false });
    this.#running(false);
  }

  setPace(stepsPerSecond) {
    if (stepsPerSecond > 0) this.#send("pace", { stepsPerSecond });
  }

  #running(running) {
    this.running = running;
    $("wall-pause").textContent = running ? "Pause" : "Continue";
  }

  #send(task, data) {
    if (!this.#worker) {
      this.#worker = new Worker(new URL("wall-worker.js", import.meta.url), { type: "module" });
      this.#worker.addEventListener("message", ({ data }) => this.#receive(data));
      this.#worker.addEventListener("error", ({ message }) => this.report(new Error(`the wall's worker failed: ${message}`)));
      const surface = $("picture").transferControlToOffscreen();
      this.#worker.postMessage({ task: "open", module: this.engine.module, surface }, [surface]);
    }
    this.#worker.postMessage({ task, ...data });
  }

  #receive({ error, tile, state, rate }) {
    if (error) {
      this.#running(false);
      this.link = null;
      return this.report(new Error(error));
    }
    if (tile) return this.play(tile);
    const isNew = !this.state;
    this.state = state;
    if (isNew) {
      $("picture").style.aspectRatio = `${state.width} / ${state.height}`;
      $("picture").style.setProperty("--wall", state.width / state.height);
      this.changed(this.link);
    }
    this.#table();
    if (rate === null) return;
    this.rate = rate;
    const number = state.groups.reduce((sum, group) => sum + group.num_envs, 0);
    this.say(`${Math.round(rate * number).toLocaleString("en")} steps per second. A click on an environment plays it.`);
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
    const { columns, groups } = this.state;
    const number = groups.reduce((sum, group) => sum + group.num_envs, 0);
    const row = Math.floor(((event.clientY - top) / height) * Math.ceil(number / columns));
    const place = row * columns + Math.floor(((event.clientX - left) / width) * columns);
    if (place < number) this.#send("tile", { place });
  }
}
