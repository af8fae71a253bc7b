// Many self-playing environments on one canvas, which a worker steps and draws.

import { $, make } from "./dom.js";
import { live } from "./live.js";

export class Wall {
  #worker = null;

  /** Whether the browser has what a wall needs. */
  static works = "transferControlToOffscreen" in HTMLCanvasElement.prototype;

  /** How often a second each environment steps, and the wall is drawn; null before the first report. */
  rate = null;
  pictures = null;

  /** The place of the environment that the keyboard has chosen. */
  #place = 0;

  /** Calls `changed(wall)` when a wall starts, and `play(episode)` when the user clicks one of its environments. */
  constructor(engine, specs, { changed, play, report }) {
    Object.assign(this, { engine, specs, changed, play, report });
    this.say = live($("wall-status"));
    $("wall-pause").addEventListener("click", () => (this.running ? this.stop() : this.resume()));
    $("wall-pace").addEventListener("input", () => this.setPace(Number($("wall-pace").value)));
    for (const control of ["wall-count", "wall-by"]) {
      $(control).addEventListener("change", () => this.start({ ...this.link, count: $("wall-count").value, by: $("wall-by").value }));
    }
    $("picture").addEventListener("click", (event) => this.#play(this.#placeAt(event)));
    $("picture").addEventListener("pointermove", (event) => {
      const place = this.#placeAt(event);
      $("picture").title = this.state && place < this.#count() ? this.#name(place) : "";
    });
    $("picture").addEventListener("keydown", (event) => this.#key(event));
    $("picture").addEventListener("focus", () => this.#choose(this.#place));
    $("picture").addEventListener("blur", () => ($("chosen").hidden = true));
  }

  /** Starts a wall of the environment `wall`, or of all of them. */
  start({ wall, count, by, options = {} }) {
    const ids = wall === "all" ? this.specs.filter((spec) => spec.shown).map((spec) => spec.id) : [wall];
    const counts = [...$("wall-count").options].map((option) => option.value);
    const number = counts.includes(count) ? Number(count) : 100;
    const hasExpert = this.specs.some((spec) => ids.includes(spec.id) && spec.has_expert);
    const expert = by !== "random" && hasExpert;
    $("wall-count").value = String(number);
    // Without an expert, there is nothing to choose from.
    $("wall-by").parentElement.hidden = !hasExpert;
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

  #receive({ error, tile, state, rate, pictures }) {
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
      this.#names();
      $("chosen").hidden = true;
      this.changed(this.link);
    }
    this.#table();
    if (rate === null) return;
    [this.rate, this.pictures] = [rate, pictures];
    if ($("chosen").hidden) this.say(`${Math.round(rate * this.#count()).toLocaleString("en")} steps per second.`);
  }

  #table() {
    const number = (value) => (value === null ? "–" : value.toFixed(2));
    $("wall-table").replaceChildren(...this.state.groups.map((group) => {
      const cells = [group.episodes, number(group.mean_return), number(group.mean_length)];
      return make("tr", {}, make("th", { scope: "row" }, group.id), ...cells.map((cell) => make("td", {}, cell)));
    }));
  }

  #count() {
    return this.state.groups.reduce((sum, group) => sum + group.num_envs, 0);
  }

  /** Writes each group's id over its first environment. */
  #names() {
    let place = 0;
    $("wall-names").replaceChildren(...this.state.groups.map(({ id, num_envs: number }) => {
      const name = make("span", {}, id);
      this.#put(name, place, Math.min(number, this.state.columns - (place % this.state.columns)));
      place += number;
      return name;
    }));
  }

  /** Lays an element over environments from a place on. */
  #put(element, place, width = 1) {
    const { columns } = this.state;
    const [column, row] = [100 / columns, 100 / Math.ceil(this.#count() / columns)];
    const sides = { left: (place % columns) * column, top: Math.floor(place / columns) * row, width: width * column, height: row };
    for (const [side, share] of Object.entries(sides)) element.style.setProperty(side, `${share}%`);
  }

  #name(place) {
    let rest = place;
    const group = this.state.groups.find(({ num_envs: number }) => (rest < number ? true : ((rest -= number), false)));
    return `${group.id}, ${rest + 1} of ${group.num_envs}`;
  }

  #placeAt({ clientX, clientY }) {
    if (!this.state) return Infinity;
    const { left, top, width, height } = $("picture").getBoundingClientRect();
    const { columns } = this.state;
    const row = Math.floor(((clientY - top) / height) * Math.ceil(this.#count() / columns));
    return row * columns + Math.floor(((clientX - left) / width) * columns);
  }

  #play(place) {
    if (this.state && place < this.#count()) this.#send("tile", { place });
  }

  /** Marks and names the environment that Enter plays. */
  #choose(place) {
    if (!this.state || !$("picture").matches(":focus-visible")) return;
    this.#place = Math.max(0, Math.min(place, this.#count() - 1));
    this.#put($("chosen"), this.#place);
    $("chosen").hidden = false;
    $("picture").ariaLabel = `Many environments; chosen: ${this.#name(this.#place)}`;
    this.say(this.#name(this.#place));
  }

  #key(event) {
    const { columns } = this.state ?? {};
    const by = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns }[event.code];
    if (event.code === "Enter") this.#play(this.#place);
    else if (by && this.#place + by >= 0 && this.#place + by < this.#count()) this.#choose(this.#place + by);
    if (by || event.code === "Enter") event.preventDefault();
  }
}
