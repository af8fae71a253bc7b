// The page: selects an engine, and shows what the server says about it.

import { Curves } from "./curves.js";
import { $, make } from "./dom.js";
import { Table, engines } from "./engines.js";
import { decode, frameBytes, paint } from "./frames.js";
import { duration, grouped, megabytes, processes, short } from "./numbers.js";

const RETRY = 1000;

/** Seconds after a request for which an engine counts as used, although its list of trainers may be older than the trainer. */
const USED = 6;

/** Maximum number of environments for which the grid has captions. */
const CAPTIONS = 36;

class View {
  constructor() {
    this.service = null;
    this.socket = null;
    this.frames = 0;
    this.about = null;
    this.status = {};
    this.newest = null;
    this.group = 0;
    this.first = 0;
    this.large = null;
    this.curves = new Curves($("curves"));
    this.table = new Table($("engines"), (service) => this.choose(service));
    this.#listen();
  }

  /** Shows the server's default engine, or the list. */
  async start() {
    this.given = (await engines()).service ?? "";
    addEventListener("popstate", () => this.show(this.#named()));
    this.show(this.#named());
    await this.#list();
    // Listing costs more than reading one engine's status, so refresh only while the list is visible.
    setInterval(() => this.service === "" && !document.hidden && this.#list().catch(() => {}), 2000);
    // The times of a lost engine go on.
    setInterval(() => this.service && this.#numbers(), 1000);
  }

  /** The engine in the address, or the one that the server shows first; an empty name for the list. */
  #named() {
    return new URLSearchParams(location.hash.slice(1)).get("engine") ?? this.given;
  }

  /** Shows an engine, which stays in the address, so that Back and a reload lead to it. */
  choose(service) {
    // Not relative to the document's base.
    history.pushState(null, "", `${location.pathname}${location.search}#${new URLSearchParams({ engine: service })}`);
    this.show(service);
  }

  /** Shows an engine, or the list for an empty name. */
  show(service) {
    this.service = service;
    [this.group, this.first, this.large, this.about, this.newest] = [0, 0, null, null, null];
    $("large").hidden = true;
    this.socket?.close();
    this.curves.clear();
    this.#read({});
    $("live").hidden = service === "";
    $("list").hidden = service !== "";
    $("grid").replaceChildren();
    // Its position depends on the content above it.
    document.querySelector("footer").hidden = false;
    $("engine").value = service;
    $("connect").querySelector("code").textContent = `endless_gym.connect(${JSON.stringify(service)})`;
    document.title = service === "" ? "Endless Gym: view" : `${service} – Endless Gym`;
    if (service === "") this.#state("list", "engines");
    else this.#connect();
  }

  async #list() {
    const answer = await engines();
    const names = answer.engines.map((engine) => engine.service);
    if (this.service && !names.includes(this.service)) names.push(this.service);
    const options = [["", "All engines"], ...names.map((name) => [name, name])];
    const known = [...$("engine").options].map((option) => option.value).join("\n");
    if (known !== options.map(([value]) => value).join("\n")) {
      $("engine").replaceChildren(...options.map(([value, text]) => new Option(text, value)));
    }
    $("engine").value = this.service ?? "";
    this.table.show(answer.engines);
    $("none").hidden = answer.engines.length > 0;
    $("table").hidden = answer.engines.length === 0;
    $("root").textContent = answer.root;
  }

  #connect() {
    const service = this.service;
    const address = new URL(`socket?service=${encodeURIComponent(service)}`, document.baseURI);
    address.protocol = "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.#state("waiting", "connecting");
    socket.addEventListener("open", () => this.#select());
    socket.addEventListener("message", ({ data }) => {
      if (socket !== this.socket) return;
      if (typeof data === "string") this.#points(JSON.parse(data));
      else this.#received(decode(data));
    });
    socket.addEventListener("close", () => {
      if (socket !== this.socket || service !== this.service) return;
      this.#state("lost", "the server has ended");
      setTimeout(() => socket === this.socket && this.#connect(), RETRY);
    });
  }

  #points({ anew, points }) {
    if (anew) this.curves.clear();
    this.curves.add(points);
  }

  #received({ about, pixels }) {
    const words = { lost: "lost: waiting for the engine", waiting: "waiting for the engine", refused: about.reason };
    if (about.state !== "live") {
      $("nothing").textContent = `The engine ${this.service} does not run. This page shows it when it starts.`;
      this.#state(about.state, words[about.state]);
      return;
    }
    const { trainers, seconds_since_request: since } = about.status ?? {};
    const isUsed = trainers?.length > 0 || (since ?? Infinity) < USED;
    this.#state(isUsed ? "live" : "idle", isUsed ? "live" : "no trainer");
    $("nothing").textContent = isUsed
      ? "The trainer has not stepped this engine since this page was opened. Its next step appears here."
      : "No trainer is connected to this engine. The environments appear with its first step.";
    const before = this.about;
    this.about = about;
    if (before?.num_envs !== about.num_envs || before?.groups !== about.groups) this.#layout(about);
    if (about.status && about.status.uptime_seconds !== this.status.uptime_seconds) this.#read(about.status);
    if (!about.batch || about.batch.group !== this.group || about.batch.envs.length === 0) return;
    this.frames += 1;
    const { frame, envs, features } = about.batch;
    $("no-frames").hidden = about.has_frames;
    $("views").hidden = !about.has_frames;
    $("rows").hidden = features.length === 0;
    if (features.length > 0) this.#rows(about.batch);
    if (frame) {
      this.newest = { frame, envs, pixels, names: about.batch.ground_truth };
      this.#paint(this.newest);
    } else $("nothing").textContent = "The engine has not drawn these environments yet.";
  }

  #state(state, text) {
    $("state").dataset.state = state;
    $("state").textContent = text;
    $("live").classList.toggle("lost", state === "lost");
  }

  /** Keeps the engine's status and the time of its reading. */
  #read(status) {
    [this.status, this.readAt] = [status, performance.now()];
    this.#numbers();
  }

  #numbers() {
    const { status } = this;
    const ago = (seconds) => `${duration(seconds + (performance.now() - this.readAt) / 1000)} ago`;
    const values = [
      ["Environment", status.id ?? "–"],
      ["Environments", status.groups === undefined ? "–" : `${status.groups} × ${status.num_envs}`],
      ["Steps", grouped(status.env_steps)],
      ["Shared memory", megabytes(status.shared_memory_bytes)],
      ["Held batches", `${grouped(status.held)} + ${grouped(status.held_by_observers)} observed`],
      ["Trainer", processes(status.trainers)],
      ["Last request", (status.seconds_since_request ?? null) === null ? "none" : ago(status.seconds_since_request)],
      ["Started", status.uptime_seconds === undefined ? "–" : ago(status.uptime_seconds)],
    ];
    $("numbers").replaceChildren(...values.map(([term, value]) => make("div", {}, make("dt", {}, term), make("dd", {}, value))));
  }

  /** Updates the controls for another engine. */
  #layout(about) {
    this.group = Math.min(this.group, about.groups - 1);
    this.first = Math.min(this.first, about.num_envs - 1);
    $("group").replaceChildren(...Array.from({ length: about.groups }, (_, group) => new Option(group)));
    $("group").value = this.group;
    this.#select();
  }

  /** Tells the server which environments are shown. */
  #select() {
    const most = this.about?.num_envs ?? Infinity;
    const count = Number($("count").value);
    let envs = Array.from({ length: count }, (_, i) => this.first + i).filter((env) => env < most);
    if (this.about) {
      $("range").textContent = `${grouped(this.first)} to ${grouped(envs.at(-1))} of ${grouped(most)}`;
      // Not `disabled`, which would take the focus from a button that was pressed; the range says why.
      $("before").ariaDisabled = String(this.first === 0);
      $("after").ariaDisabled = String(this.first + count >= most);
    }
    if (this.large !== null && !envs.includes(this.large)) envs.push(this.large);
    // A page in the background needs no frames.
    if (document.hidden) envs = [];
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ group: this.group, envs }));
  }

  #paint({ frame, envs, pixels, names }) {
    const bytes = frameBytes(frame);
    const count = Number($("count").value);
    const shown = envs.filter(({ env }) => env >= this.first && env < this.first + count);
    const grid = $("grid");
    if (grid.children.length !== shown.length) grid.replaceChildren(...shown.map(() => this.#place()));
    grid.style.setProperty("--columns", Math.ceil(Math.sqrt(shown.length)));
    grid.toggleAttribute("data-many", shown.length > CAPTIONS);
    let place = 0;
    envs.forEach((each, i) => {
      if (each.env >= this.first && each.env < this.first + count) {
        const button = grid.children[place++];
        button.dataset.env = each.env;
        button.setAttribute("aria-pressed", String(each.env === this.large));
        button.lastChild.textContent = `${each.env}: ${short(each.return, 2)}`;
        paint(button.firstChild, frame, pixels, i * bytes);
      }
      if (each.env === this.large) {
        const truth = names.map((name, i) => `, ${name} ${short(each.ground_truth?.[i], 2)}`).join("");
        $("caption").textContent = `Environment ${each.env}: step ${each.length}, reward ${short(each.reward, 2)}, return ${short(each.return, 2)}${truth}`;
        paint($("enlarged"), frame, pixels, i * bytes);
      }
    });
  }

  #place() {
    const button = make("button", { type: "button" }, make("canvas"), make("span"));
    button.addEventListener("click", () => this.enlarge(Number(button.dataset.env)));
    return button;
  }

  /** Enlarges one environment; none for `null` or for the one that is already enlarged. */
  enlarge(env) {
    this.large = env === this.large ? null : env;
    $("large").hidden = this.large === null;
    $("caption").textContent = "";
    // While the trainer pauses, no new message arrives.
    if (this.newest) this.#paint(this.newest);
    this.#select();
  }

  #rows({ envs, features }) {
    const row = (kind, texts) => make("tr", {}, ...texts.map((text) => make(kind, {}, text)));
    $("columns").replaceChildren(row("th", ["environment", "step", "reward", "return", ...features]));
    $("values").replaceChildren(...envs.map((each) => row("td", [each.env, each.length, short(each.reward, 2), short(each.return, 2), ...each.features.map((number) => short(number, 2))])));
  }

  #listen() {
    const move = (change) => {
      change(Number($("count").value));
      this.#select();
    };
    document.addEventListener("visibilitychange", () => this.#select());
    $("engine").addEventListener("focus", () => this.#list().catch(() => {}));
    $("engine").addEventListener("change", () => this.choose($("engine").value));
    $("group").addEventListener("change", () => move(() => (this.group = Number($("group").value))));
    $("count").addEventListener("change", () => move((count) => (this.first -= this.first % count)));
    $("before").addEventListener("click", () => move((count) => (this.first = Math.max(0, this.first - count))));
    $("after").addEventListener("click", () => move((count) => (this.first += this.first + count < this.about?.num_envs ? count : 0)));
    $("smaller").addEventListener("click", () => this.enlarge(null));
    $("theme").addEventListener("click", () => {
      const root = document.documentElement;
      const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
      root.dataset.theme = dark ? "light" : "dark";
    });
  }
}

const view = new View();
// For tests and for the browser's console.
globalThis.endless = view;
try {
  await view.start();
} catch (error) {
  $("message").textContent = error.message;
  $("message").hidden = false;
}
