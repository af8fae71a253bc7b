// The page: connects the engine, the episode, the wall, and the address.

import { $, make } from "./dom.js";
import { Engine } from "./engine.js";
import { ParameterForm } from "./form.js";
import { isTyping } from "./keys.js";
import { episodeLink, randomSeed, readLink, wallLink } from "./link.js";
import { Play } from "./play.js";
import { questionOf } from "./tasks.js";
import { Wall } from "./wall.js";

/** Says something beside the control that it is about, over the page; an empty text takes it away. */
function say(text, near = "pause", isNote = false) {
  const box = $("message");
  box.classList.toggle("note", isNote);
  box.hidden = text === "";
  box.textContent = text;
  if (text === "") return;
  const place = ($(near).checkVisibility() ? $(near) : $("environment")).getBoundingClientRect();
  const [width, height] = [document.documentElement.clientWidth, document.documentElement.clientHeight];
  const below = place.bottom + 4;
  const top = below + box.offsetHeight <= height ? below : Math.max(4, place.top - box.offsetHeight - 4);
  box.style.left = `${Math.max(8, Math.min(place.left, width - box.offsetWidth - 8)) + scrollX}px`;
  box.style.top = `${top + scrollY}px`;
}

const report = (error) => say(error.message);

/** Most bytes of an opened file; more do not fit into the engine's memory. */
const LARGEST = 1e9;

/** The environment of a page without a link, which an agent plays until the visitor starts. */
const LANDING = "Endless-MortarMayhem-v0";

/** Whether the page is that of POPGym, which has another engine. */
const IS_POPGYM = location.search === "?popgym";

/** The wall that the page shows unless the address names another. */
const WALL = { wall: "all", count: "100", by: "expert" };

class App {
  constructor(engine) {
    this.engine = engine;
    this.specs = engine.request("specs");
    this.form = new ParameterForm($("fields"), (options) => engine.request({ check: { id: $("environment").value, options } }));
    this.play = new Play(engine, this.specs, { changed: (state) => this.#playing(state), report });
    this.hasLanding = this.specs.some((spec) => spec.id === LANDING);
    this.first = this.hasLanding ? LANDING : this.specs[0].id;
    // A page with environments of one's own has one engine.
    const isMemoryGym = this.specs.every((spec) => questionOf(spec.id) !== "");
    for (const id of ["suite", "source"]) $(id).hidden = !IS_POPGYM && !isMemoryGym;
    if (IS_POPGYM) {
      Object.assign($("suite"), { href: "./", textContent: "Memory Gym" });
      Object.assign($("source").firstElementChild, { href: "https://arxiv.org/abs/2303.01859", textContent: "POPGym" });
    }
    this.wall = new Wall(engine, this.specs, {
      changed: (wall) => this.#address(wallLink(wall)),
      play: (episode) => this.start(episode),
      report: (error) => this.#noWall(error),
    });
    $("environment").append(...this.specs.map(({ id }) => new Option(id.replace("popgym-", ""), id)));
    $("to-wall").parentElement.hidden = this.specs.every((spec) => !spec.shown);
    $("agent").hidden = this.specs.every((spec) => !this.play.agents.has(spec.id));
    this.#listen();
  }

  /** Starts the episode or wall in the address. */
  follow() {
    const link = readLink(location.hash);
    if (link.wall !== undefined) return this.showWall(link);
    if (location.hash === "" && this.hasLanding) {
      this.#view("play");
      return this.play.demo({ id: this.first, options: {}, seed: randomSeed() });
    }
    const episode = { id: link.id ?? this.first, options: link.options, seed: link.seed ?? randomSeed() };
    this.start(episode);
    if (!$("message").hidden) return;
    if (link.by === "agent") this.play.playAgent(episode);
    else if (link.by === "expert") this.play.choose("expert");
    else if (link.by) say(`by must be agent or expert, got \`${link.by}\``, "person");
  }

  /** Starts an episode, or reports why it cannot. */
  start(episode, near = "environment") {
    this.#view("play");
    say("");
    try {
      this.play.start(episode);
    } catch (error) {
      say(error.message, near);
      if (!this.play.state) this.play.start({ id: this.first, options: {}, seed: randomSeed() });
    }
  }

  showWall(link) {
    if (!Wall.works) {
      if (!this.play.state) this.start({ id: this.first, options: {}, seed: randomSeed() });
      return say("The wall needs OffscreenCanvas, which this browser lacks. Everything else works.", "to-wall");
    }
    this.#view("wall");
    say("");
    this.#allOption(true);
    $("environment").value = link.wall;
    // The wall that an episode was chosen from goes on.
    if (this.wall.link && wallLink(this.wall.link) === location.hash) this.wall.resume();
    else this.wall.start(link);
  }

  /** Says why there is no wall, and plays the environment alone. */
  #noWall(error) {
    const wanted = $("environment").value;
    const id = this.specs.some((spec) => spec.id === wanted) ? wanted : (this.play.state?.id ?? this.first);
    if (!this.wall.state) this.start({ id, options: {}, seed: randomSeed() });
    say(error.message, "environment");
  }

  #allOption(wanted) {
    const all = $("environment").querySelector("[value=all]");
    if (wanted && !all) $("environment").prepend(new Option("All", "all"));
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
    this.form.show(this.play.spec, state.options);
    if (this.play.isDemo) return;
    document.title = `${state.id} – Endless Gym`;
    const { player, agents } = this.play;
    const by = player === "expert" || (player === "agent" && !agents.isOwn(state.id)) ? player : undefined;
    this.#address(episodeLink({ ...state, seed: state.seed ?? "0", by }));
  }

  /** Sets the address. Back leads from an episode to the wall before it, or the reverse, and not from one seed to another. */
  #address(hash) {
    const isWall = (address) => readLink(address).wall !== undefined;
    if (location.hash === hash) return;
    if (location.hash !== "" && isWall(hash) !== isWall(location.hash)) history.pushState(null, "", hash);
    else history.replaceState(null, "", hash);
  }

  #listen() {
    addEventListener("hashchange", () => this.follow());
    $("to-play").addEventListener("click", () => {
      const shown = this.wall.link?.wall;
      const id = shown && shown !== "all" ? shown : this.play.state?.id ?? this.first;
      if (this.play.state?.id !== id) return this.start({ id, options: {}, seed: randomSeed() });
      this.#view("play");
      this.#playing(this.play.state);
    });
    $("to-wall").addEventListener("click", () => this.showWall(WALL));
    $("environment").addEventListener("change", () => {
      const id = $("environment").value;
      if (this.play.active) this.start({ id, options: {}, seed: $("seed").value || randomSeed() });
      else this.wall.start({ wall: id, count: $("wall-count").value, by: $("wall-by").value });
    });
    $("seed").addEventListener("change", () => this.#restart("seed"));
    $("form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#restart("submit");
    });
    this.#giveKeysBack();
    $("defaults").addEventListener("click", () => {
      this.form.show(this.play.spec, {});
      this.#restart("defaults");
    });
    $("save").addEventListener("click", () => this.#save());
    $("open").addEventListener("click", () => $("file").click());
    $("file").addEventListener("change", () => this.#open($("file").files[0]));
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => {
      event.preventDefault();
      this.#open(event.dataTransfer.files[0]);
    });
    for (const id of ["copy", "share"]) $(id).addEventListener("click", () => this.#copy(id));
    $("theme").addEventListener("click", () => {
      const dark = getComputedStyle(document.documentElement).colorScheme.startsWith("dark") ||
        (!document.documentElement.dataset.theme && matchMedia("(prefers-color-scheme: dark)").matches);
      setTheme(dark ? "light" : "dark");
    });
  }

  /** Gives the keys back to the game after a control was used: by the pointer, or the keyboard for what starts or ends something. */
  #giveKeysBack() {
    const give = () => this.play.active && $("observation").focus({ preventScroll: true });
    addEventListener("click", ({ target, detail }) => {
      if (target.closest("#play > :not(#hands), header") && (detail > 0 || target.closest("button")) && !isTyping(target) && !target.matches("select, label")) give();
    });
    // An arrow that changes a control keeps the keys there.
    addEventListener("change", ({ target }) => target.matches("select:not(:focus-visible)") && give());
    addEventListener("keydown", ({ target, code }) => {
      if (code === "Escape") say("");
      if ((code === "Enter" || code === "Escape") && target.matches("#seed, #pace")) give();
    });
    addEventListener("pointerdown", ({ target }) => target !== $("message") && say(""));
  }

  #restart(near) {
    const seed = $("seed").value;
    this.start({ id: $("environment").value, options: this.form.options(), seed }, near);
    // Keep what was typed, even if the engine rejects it.
    if (!$("message").hidden) $("seed").value = seed;
  }

  #save() {
    const { bytes, name } = this.play.recording();
    const url = URL.createObjectURL(new Blob([bytes], { type: "application/gzip" }));
    make("a", { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10_000);
    say(`Saved as ${name}; \`endless verify ${name}\` replays it.`, "save", true);
  }

  async #open(file) {
    $("file").value = "";
    if (!file) return;
    try {
      if (file.size > LARGEST) throw new Error(`the file has ${(file.size / 1e9).toFixed(1)} GB; recordings and agents have at most ${LARGEST / 1e9} GB`);
      if (file.name.endsWith(".safetensors")) return this.#openAgent(new Uint8Array(await file.arrayBuffer()));
      const { episodes, steps, differences, first } = this.play.open(new Uint8Array(await file.arrayBuffer()));
      this.#view("play");
      const verdict = differences === 0 ? "replayed without a difference" : `${differences} differences, the first in ${first}`;
      say(`${file.name}: ${count(episodes, "episode")}, ${count(steps, "step")}, ${verdict}.`, "open", differences === 0);
    } catch (error) {
      say(`${file.name}: ${error.message}`, "open");
    }
  }

  /** Lets the agent of a file play. */
  #openAgent(bytes) {
    const { env } = this.play.agents.open(bytes);
    if (!this.specs.some(({ id }) => id === env)) throw new Error(`the agent was trained in ${env}, which is not on this page`);
    this.#view("play");
    $("agent").hidden = false;
    const { seed } = this.play.state ?? {};
    this.play.playAgent({ id: env, options: {}, seed: seed ?? randomSeed() });
  }

  async #copy(near) {
    try {
      await navigator.clipboard.writeText(location.href);
      say("The link to this episode is in the clipboard.", near, true);
    } catch {
      say(`The browser refuses access to the clipboard; the link is ${location.href}`, near);
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
  const app = new App(await Engine.load(IS_POPGYM ? "popgym.wasm" : "engine.wasm"));
  // For tests and for the browser's console.
  globalThis.endless = app;
  app.follow();
  $("play").ariaBusy = "false";
} catch (error) {
  $("overlay").hidden = true;
  say(globalThis.WebAssembly ? error.message : "This page needs WebAssembly, which this browser lacks or has switched off.");
}

if ("serviceWorker" in navigator) navigator.serviceWorker.register("worker.js").catch(() => {});
