// The page: connects the engine, the episode, the wall, and the address.

import { Engine } from "./engine.js";
import { ParameterForm } from "./form.js";
import { episodeLink, readLink, wallLink } from "./link.js";
import { Play } from "./play.js";
import { Wall } from "./wall.js";

const $ = (id) => document.getElementById(id);

function say(text, isNote = false) {
  $("message").textContent = text;
  $("message").classList.toggle("note", isNote);
  $("message").hidden = text === "";
}

const report = (error) => say(error.message);

/** One of the paper's training seeds. */
const randomSeed = () => String(crypto.getRandomValues(new Uint32Array(1))[0] % 100_000);

class App {
  constructor(engine) {
    this.engine = engine;
    this.specs = engine.request("specs");
    this.first = this.specs[0].id;
    this.form = new ParameterForm($("fields"), (options) => engine.request({ check: { id: $("environment").value, options } }));
    this.play = new Play(engine, this.specs, { changed: (state) => this.#playing(state), report });
    this.wall = new Wall(engine, this.specs, {
      changed: (wall) => this.#address(wallLink(wall)),
      play: (id) => this.start({ id, options: {}, seed: randomSeed() }),
      report,
    });
    this.#environments();
    $("to-wall").disabled = this.specs.every((spec) => !spec.frame);
    $("agent").hidden = this.specs.every((spec) => !this.play.agents.has(spec.id));
    this.#listen();
  }

  /** Starts the episode or wall in the address. */
  follow() {
    const link = readLink(location.hash);
    if (link.wall !== undefined) return this.showWall(link);
    const episode = { id: link.id ?? this.first, options: link.options, seed: link.seed ?? randomSeed() };
    this.start(episode);
    if (!$("message").hidden) return;
    if (link.by === "agent") this.play.playAgent(episode);
    else if (link.by === "expert") this.play.toggleExpert();
    else if (link.by) say(`by must be agent or expert, got \`${link.by}\``);
  }

  /** Starts an episode, or reports why it cannot. */
  start(episode) {
    this.#view("play");
    say("");
    try {
      this.play.start(episode);
    } catch (error) {
      report(error);
      if (!this.play.state) this.play.start({ id: this.first, options: {}, seed: randomSeed() });
    }
  }

  showWall(link) {
    this.#view("wall");
    say("");
    this.#allOption(true);
    this.wall.start(link);
    if (this.wall.id) $("environment").value = this.wall.id;
  }

  #environments() {
    const option = (id) => Object.assign(document.createElement("option"), { value: id, textContent: id });
    $("environment").replaceChildren(...this.specs.map((spec) => option(spec.id)));
  }

  #allOption(wanted) {
    const all = $("environment").querySelector("[value=all]");
    if (wanted && !all) $("environment").prepend(Object.assign(document.createElement("option"), { value: "all", textContent: "All" }));
    if (!wanted) all?.remove();
  }

  #view(name) {
    const play = name === "play";
    $("play").hidden = !play;
    $("wall").hidden = play;
    $("to-play").setAttribute("aria-pressed", String(play));
    $("to-wall").setAttribute("aria-pressed", String(!play));
    this.play.active = play;
    if (play) {
      this.wall.stop();
      this.#allOption(false);
    } else {
      this.play.stop();
    }
  }

  #playing(state) {
    $("environment").value = state.id;
    $("seed").value = state.seed ?? "";
    document.title = `${state.id} – Endless Gym`;
    this.form.show(this.play.spec, state.options);
    if (Object.keys(state.options).length > 0) $("parameters").open = true;
    const by = ["agent", "expert"].find((player) => player === this.play.player);
    this.#address(episodeLink({ ...state, seed: state.seed ?? "0", by }));
  }

  #address(hash) {
    if (location.hash !== hash) history.replaceState(null, "", hash);
  }

  #listen() {
    addEventListener("hashchange", () => this.follow());
    $("to-play").addEventListener("click", () => {
      const id = this.wall.id && this.wall.id !== "all" ? this.wall.id : this.play.state?.id ?? this.first;
      if (this.play.state?.id !== id) return this.start({ id, options: {}, seed: randomSeed() });
      this.#view("play");
      this.#playing(this.play.state);
    });
    $("to-wall").addEventListener("click", () => this.showWall({ wall: "all", count: "100", by: "expert" }));
    $("environment").addEventListener("change", () => {
      const id = $("environment").value;
      if (this.play.active) this.start({ id, options: {}, seed: $("seed").value || randomSeed() });
      else this.wall.start({ wall: id, count: $("wall-count").value, by: $("wall-by").value });
      // Frees the arrow keys for playing.
      $("environment").blur();
    });
    $("seed").addEventListener("change", () => this.#restart());
    $("form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#restart();
    });
    $("defaults").addEventListener("click", () => {
      this.form.show(this.play.spec, {});
      this.#restart();
    });
    $("save").addEventListener("click", () => this.#save());
    $("open").addEventListener("click", () => $("file").click());
    $("file").addEventListener("change", () => this.#open($("file").files[0]));
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => {
      event.preventDefault();
      this.#open(event.dataTransfer.files[0]);
    });
    $("copy").addEventListener("click", () => this.#copy());
    $("theme").addEventListener("click", () => {
      const dark = getComputedStyle(document.documentElement).colorScheme.startsWith("dark") ||
        (!document.documentElement.dataset.theme && matchMedia("(prefers-color-scheme: dark)").matches);
      setTheme(dark ? "light" : "dark");
    });
  }

  #restart() {
    const seed = $("seed").value;
    this.start({ id: $("environment").value, options: this.form.options(), seed });
    // Keep what was typed, even if the engine rejects it.
    if (!$("message").hidden) $("seed").value = seed;
  }

  #save() {
    const { bytes, name } = this.play.recording();
    const url = URL.createObjectURL(new Blob([bytes], { type: "application/gzip" }));
    Object.assign(document.createElement("a"), { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10_000);
    say(`Saved as ${name}; \`endless verify ${name}\` replays it.`, true);
  }

  async #open(file) {
    $("file").value = "";
    if (!file) return;
    try {
      const { episodes, steps, differences, first } = this.play.open(new Uint8Array(await file.arrayBuffer()));
      this.#view("play");
      const verdict = differences === 0 ? "replayed without a difference" : `${differences} differences, the first in ${first}`;
      say(`${file.name}: ${count(episodes, "episode")}, ${count(steps, "step")}, ${verdict}.`, differences === 0);
    } catch (error) {
      say(`${file.name}: ${error.message}`);
    }
  }

  async #copy() {
    try {
      await navigator.clipboard.writeText(location.href);
      say("The link to this episode is in the clipboard.", true);
    } catch {
      say(`The browser refuses access to the clipboard; the link is ${location.href}`);
    }
  }
}

function count(number, what) {
  return `${number} ${what}${number === 1 ? "" : "s"}`;
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  try {
    localStorage.setItem("theme", theme);
  } catch {
    // The browser may refuse storage; the choice then lasts until the page is closed.
  }
}

try {
  const theme = localStorage.getItem("theme");
  if (theme === "light" || theme === "dark") document.documentElement.dataset.theme = theme;
} catch {
  // As above.
}

try {
  const app = new App(await Engine.load());
  // For tests and for the browser's console.
  globalThis.endless = app;
  app.follow();
  // For measurements: milliseconds from the start of navigation to the frame after the first picture.
  requestAnimationFrame((now) => (app.firstFrame = now));
} catch (error) {
  report(error);
}

if ("serviceWorker" in navigator) navigator.serviceWorker.register("worker.js").catch(() => {});
