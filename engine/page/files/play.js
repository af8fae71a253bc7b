// The episode on the screen: its player, its pace, and its display.

import { Agents } from "./agents.js";
import { Answer } from "./answer.js";
import { ActionControls } from "./controls.js";
import { $, disable, make } from "./dom.js";
import { flash } from "./flash.js";
import { Directions, isTyping } from "./keys.js";
import { randomSeed } from "./link.js";
import { live } from "./live.js";
import { showMemory } from "./memory.js";
import { Pace } from "./pace.js";
import { Rival } from "./rival.js";
import { enable, tone } from "./sound.js";
import { actionFor, actionText, choiceName, commandsOf, isTurnBased, legendOf, outcomeOf, questionOf, scoreNumber, steering, TASKS, waits } from "./tasks.js";

const PAD = [["left up", "↖"], ["up", "↑"], ["right up", "↗"], ["left", "←"], null, ["right", "→"], ["left down", "↙"], ["down", "↓"], ["right down", "↘"]];

const STEP_REQUESTS = { expert: "step_of_expert", agent: "step_of_agent", trace: "step_of_trace" };

/** Milliseconds between two episodes of an agent. */
const BREAK = 2500;

// A phone has no keys.
const TOUCH = matchMedia("(pointer: coarse)").matches;
const GO = TOUCH ? "A tap" : "Space";

export class Play {
  /** Calls `changed(episode)` when an episode starts, and `report(error)` with the engine's errors. */
  constructor(engine, specs, { changed, report }) {
    this.engine = engine;
    this.specs = specs;
    this.changed = changed;
    this.report = report;
    this.state = null;
    this.player = "person";
    /** Whether an agent plays until the visitor starts. */
    this.isDemo = false;
    /** The reset parameters before an agent played with those of its training. */
    this.before = null;
    this.say = live($("status"));
    this.agents = new Agents(engine);
    this.answer = new Answer(engine, this.agents, (text) => this.say(text));
    this.rival = new Rival(engine, this.agents);
    this.directions = new Directions(() => this.#takeOver(() => this.play()));
    this.directions.attach($("pad"));
    this.controls = new ActionControls($("action"), () => this.#takeOver(() => this.oneStep()));
    this.pace = new Pace(25, (count) => this.#steps(count));
    this.active = true;
    this.#listen();
  }

  get spec() {
    return this.specs.find((spec) => spec.id === this.state?.id);
  }

  /** Starts an episode of the given environment. Throws the engine's error. */
  start({ id, options, seed }, player = "person", isDemo = false) {
    const state = this.engine.request({ start: { id, options, seed } });
    [this.player, this.isDemo] = [player, isDemo];
    if (player !== "agent") this.before = null;
    this.#begin(state);
    if (player === "expert" || player === "agent") this.play();
  }

  /** Loads the agent of an environment and lets it play. Reset parameters default to those of its training. */
  async playAgent({ id, options, seed }, isDemo = false) {
    const { state } = this;
    try {
      await this.agents.load(id);
    } catch (error) {
      // The landing does without.
      return isDemo ? undefined : this.report(error);
    }
    // The user may have started another episode meanwhile.
    if (this.state !== state) return;
    this.before = options;
    this.#attempt(() => this.start({ id, options: { ...this.agents.options(id), ...options }, seed }, "agent", isDemo));
  }

  /** Lets an agent play until the visitor starts. */
  async demo(episode) {
    this.start(episode, "person", true);
    await this.playAgent(episode, true);
    if (this.isDemo && matchMedia("(prefers-reduced-motion: reduce)").matches) this.stop();
  }

  /** Ends the demonstration with an episode of the visitor's own, which nobody has seen yet. */
  #startOwn() {
    this.#attempt(() => this.start({ ...this.state, seed: randomSeed() }));
    this.play();
  }

  /** Lets a person, the expert or the agent play. Expert and agent must see an episode from its start. */
  choose(player) {
    if (this.isDemo && player === "person") return this.#startOwn();
    if (!this.state || player === this.player) return;
    // A recording may have no seed.
    const episode = { ...this.state, options: this.before ?? this.state.options, seed: this.state.seed ?? "0" };
    if (player === "agent") return this.playAgent(episode);
    if (player === "expert" && !this.spec.has_expert) return this.report(new Error(this.#noExpert()));
    if (player === "expert") return this.#attempt(() => this.start(episode, "expert"));
    if (this.before) return this.#attempt(() => this.start(episode));
    this.player = "person";
    this.changed(this.state);
    this.stop();
  }

  /** The reset parameters of the same player's next episode: unless it is the agent, those from before the agent. */
  #options() {
    return (this.player !== "agent" && this.before) || this.state.options;
  }

  /** Opens a trace's file. */
  open(bytes) {
    const { state, ...outcome } = this.engine.open(bytes);
    this.player = "trace";
    this.file = bytes;
    this.#begin(state);
    return outcome;
  }

  /** Continues the episode. */
  play() {
    if (!this.state || this.#over()) return;
    this.pace.start();
    this.#show();
  }

  stop() {
    clearTimeout(this.following);
    this.pace.stop();
    this.#show();
  }

  /** Restarts the episode. */
  restart() {
    if (!this.state) return;
    if (this.player === "trace") this.#attempt(() => this.open(this.file));
    else this.#attempt(() => this.start({ ...this.state, options: this.#options() }, this.player));
  }

  /** Starts the episode whose seed is larger by `by`. */
  otherSeed(by, isDemo = false) {
    if (!this.state) return;
    const seed = BigInt.asUintN(64, BigInt(this.state.seed ?? 0) + BigInt(by)).toString();
    this.#attempt(() => this.start({ ...this.state, options: this.#options(), seed }, this.player === "trace" ? "person" : this.player, isDemo));
  }

  /** Plays one step and stops. */
  oneStep() {
    if (!this.state || this.#over()) return;
    this.pace.stop();
    this.#steps(1, true);
  }

  /** The recording as a trace file, and its name. */
  recording() {
    const { id, seed, length } = this.state;
    return { bytes: this.engine.request("save"), name: `${id}.seed-${seed ?? "none"}.${length}-steps.json.gz` };
  }

  setPace(stepsPerSecond) {
    if (stepsPerSecond > 0) this.pace.stepsPerSecond = stepsPerSecond;
  }

  #begin(state) {
    const other = this.state?.id !== state.id;
    clearTimeout(this.following);
    this.pace.stop();
    this.state = state;
    this.directions.clear();
    if (other) {
      $("question").textContent = questionOf(state.id);
      $("summary").textContent = TASKS[state.id] ?? this.spec.summary;
      this.#legend();
      this.#pad();
      this.controls.show(this.spec);
      this.#frame(this.spec.shown);
      this.#originalPace();
    }
    this.changed(state);
    const isRivalled = this.player === "agent" && !this.agents.isOwn(state.id) && this.agents.names(state.id).length > 1;
    this.rival.begin(state, isRivalled).catch(this.report);
    this.#show();
    $("view").setAttribute("aria-label", `Ground truth of ${state.id}`);
  }

  /** Gives the canvases the size of a frame, or shows features instead. */
  #frame(frame) {
    const { width, height } = frame ?? { width: 84, height: 84 };
    for (const canvas of [$("observation"), $("view")]) Object.assign(canvas, { width, height });
    const style = document.documentElement.style;
    for (const [name, value] of Object.entries({ width, height, side: Math.max(width, height) })) style.setProperty(`--frame-${name}`, value);
    $("truth").hidden = !frame;
    $("observation").hidden = !frame;
    $("features").hidden = Boolean(frame);
  }

  #originalPace() {
    $("pace").value = this.spec.render_fps;
    this.setPace(this.spec.render_fps);
  }

  /** Whether there is nothing more to play. */
  #over() {
    if (!this.state) return true;
    return this.player === "trace" ? this.state.recording.over : this.state.done;
  }

  /** Continues the episode by `go`, as a person. */
  #takeOver(go) {
    if (!this.active || !this.state) return;
    if (this.isDemo) return this.#startOwn();
    if (this.state.done) return;
    if (this.player !== "person") {
      this.player = "person";
      this.changed(this.state);
    }
    go();
  }

  #steps(count, single = false) {
    this.#attempt(() => {
      for (let step = 0; step < count && !this.#over(); step += 1) {
        const by = STEP_REQUESTS[this.player];
        const directions = this.directions.take();
        if (!by && !single && directions.length === 0 && waits(this.spec)) break;
        this.state = this.engine.request(by ?? { step: { action: actionFor(this.spec, directions, this.controls.action()) } });
        this.#sound();
        this.#flash();
        if (this.player === "agent" && this.state.done) this.agents.count(this.state, outcomeOf(this.state) === "success", scoreNumber(this.state));
      }
    });
    if (this.#over()) {
      this.pace.stop();
      // A running agent plays one episode after the other.
      if (this.player === "agent" && this.state.done && !single) this.following = setTimeout(() => this.otherSeed(1, this.isDemo), BREAK);
    }
    this.#show();
  }

  #flash() {
    if (!$("flash").checked) return;
    const { done, reward } = this.state;
    const outcome = outcomeOf(this.state);
    const kind = done ? (outcome === "success" ? "success" : "failure") : reward > 0 ? "reward" : reward < 0 ? "damage" : null;
    if (kind) flash($("observation").closest(".screen"), kind);
  }

  #sound() {
    if (!$("sound").checked) return;
    if (this.state.done) tone(this.state.return > 0 ? 330 : 165, 0.3);
    else if (this.state.reward > 0) tone(660, 0.12);
    else if (this.state.reward < 0) tone(165, 0.12);
  }

  #attempt(action) {
    try {
      action();
    } catch (error) {
      this.pace.stop();
      this.report(error);
    }
  }

  #show() {
    const { state, spec } = this;
    if (!state) return;
    if (spec.shown) {
      $("observation").getContext("2d").putImageData(this.engine.observation(spec.shown), 0, 0);
      $("view").getContext("2d").putImageData(this.engine.view(spec.shown), 0, 0);
    } else {
      showNumbers($("features"), spec.features.map(({ name }, index) => ({ name, value: state.features[index] })));
    }
    showNumbers($("numbers"), [
      { name: "steps", value: state.length, of: state.recording?.steps },
      { name: "action", text: state.length > 0 ? actionText(spec, state.action) : "–" },
      { name: "last reward", value: state.reward },
      { name: "return", value: state.return },
      ...state.progress,
    ]);
    const { arrows, words } = commandsOf(state);
    $("commands").hidden = arrows === "";
    $("arrows").textContent = arrows;
    $("words").textContent = words;
    const running = this.pace.running;
    $("pause").textContent = this.isDemo ? "Play" : this.#over() ? "New episode" : running ? "Pause" : state.length === 0 ? "Start" : "Continue";
    // The text on the picture says why.
    $("step").ariaDisabled = String(this.#over());
    document.body.classList.toggle("demo", this.isDemo);
    this.rival.follow(state, spec);
    this.answer.show(this.player === "person" && state.done ? state : null);
    disable("expert", this.#noExpert());
    for (const player of ["person", "expert", "agent"]) $(player).setAttribute("aria-pressed", String(this.player === player));
    this.#agent();
    $("truth").classList.toggle("covered", this.player === "person" && !this.#over() && !$("show-truth").checked);
    this.say(this.#said(state));
    const text = this.#text();
    $("overlay").hidden = text === "";
    $("said").textContent = text;
    $("choices").hidden = !this.#over() || this.isDemo;
    // On the picture then; their places stay, so that nothing moves.
    const hide = (id, isHidden) => ($(id).style.visibility = isHidden && !this.isDemo ? "hidden" : "");
    for (const id of ["restart", "next"]) hide(id, this.#over());
    // Each choice plays a step.
    hide("pause", isTurnBased(spec) && this.player === "person" && !this.#over());
  }

  /** Why no expert can play, or an empty string. */
  #noExpert() {
    return this.spec.has_expert ? "" : `${this.spec.id} has no scripted expert.`;
  }

  #agent() {
    const { player, state } = this;
    disable("agent", $("agent").hidden ? "" : this.agents.reason(state.id));
    // Shown before the agent plays, too, so that nothing moves when it does.
    $("memory").hidden = state.clues === null;
    if (state.clues) showMemory(state, this.agents, player === "person");
  }

  #said({ recording }) {
    const end = this.#over() ? ` ${this.#text()}` : "";
    if (this.isDemo) return "An agent plays. Play or a direction starts an episode of your own.";
    if (this.player === "person") return `You play.${end}`;
    const who = { expert: "The expert plays", agent: "The agent plays" }[this.player] ?? `Recording, episode ${recording.episode + 1} of ${recording.episodes}`;
    return end === "" ? `${who}. A direction takes over.` : `${who}.${end}`;
  }

  /** What is written on the picture. */
  #text() {
    const { state } = this;
    if (this.isDemo && !state.done) return "";
    if (this.#over() && state.done) {
      const success = { success: "Done", failure: "Failed", end: "Episode over" }[outcomeOf(state)];
      return `${success}: return ${round(state.return)} in ${state.length} steps.`;
    }
    if (this.#over()) return "The recording ends here.";
    if (this.player === "person" && isTurnBased(this.spec)) return state.length === 0 ? "Choose an action." : "";
    if (state.length === 0 && !this.pace.running) {
      if (this.player === "trace") return `${GO} replays the recording.`;
      if (Object.keys(steering(this.spec)).length === 0) return `${GO} starts.`;
      return `A direction starts, or ${TOUCH ? "a tap" : "Space"}.`;
    }
    return this.pace.running ? "" : `Paused. ${GO} continues.`;
  }

  #legend() {
    $("legend").replaceChildren(...legendOf(this.state.id).map(([color, meaning]) => {
      const item = make("li", {}, meaning);
      item.style.setProperty("--color", color);
      return item;
    }));
  }

  #pad() {
    const meaning = steering(this.spec);
    const turns = meaning.up !== undefined && choiceName(this.spec, ...meaning.up) === "ahead";
    const signs = turns ? { left: "↺", right: "↻" } : {};
    $("pad").replaceChildren(...PAD.map((entry) => {
      const branches = entry?.[0].split(" ").map((direction) => meaning[direction]?.[0]) ?? [];
      // Two directions need two branches.
      if (!entry || branches.includes(undefined) || new Set(branches).size < branches.length) return make("span");
      const [directions, sign] = entry;
      const button = make("button", { type: "button", ariaLabel: directions }, signs[directions] ?? sign);
      button.dataset.directions = directions;
      return button;
    }));
    $("pad").hidden = Object.keys(meaning).length === 0;
  }

  #listen() {
    const go = () => (this.isDemo ? this.#startOwn() : this.pace.running ? this.stop() : this.play());
    const tasks = { restart: () => this.restart(), next: () => this.otherSeed(1) };
    $("pause").addEventListener("click", () => (this.#over() && !this.isDemo ? this.otherSeed(1) : go()));
    $("observation").parentElement.addEventListener("click", (event) => !event.target.closest("button") && go());
    for (const button of document.querySelectorAll("[data-do]")) button.addEventListener("click", tasks[button.dataset.do]);
    for (const player of ["person", "expert", "agent"]) $(player).addEventListener("click", () => this.choose(player));
    $("step").addEventListener("click", () => this.oneStep());
    $("pace").addEventListener("input", () => this.setPace(Number($("pace").value)));
    $("original-pace").addEventListener("click", () => this.spec && this.#originalPace());
    $("sound").addEventListener("change", () => $("sound").checked && enable());
    $("show-truth").addEventListener("change", () => this.#show());
    const toggle = (player) => () => this.choose(this.player === player ? "person" : player);
    const keys = {
      Space: go,
      KeyN: () => this.oneStep(),
      KeyR: tasks.restart,
      KeyE: toggle("expert"),
      KeyG: toggle("agent"),
      Enter: tasks.next,
      PageDown: tasks.next,
      PageUp: () => this.otherSeed(-1),
    };
    document.addEventListener("visibilitychange", () => document.hidden && this.player === "person" && this.pace.running && this.stop());
    addEventListener("keydown", (event) => {
      const action = keys[event.code];
      if (!this.active || !action || event.ctrlKey || event.metaKey || event.altKey || isTyping(event.target)) return;
      // Space and Enter belong to a control that the keyboard has reached.
      const onControl = event.target instanceof Element && event.target.matches(":is(button, summary, a, input):focus-visible");
      if (onControl && (event.code === "Space" || event.code === "Enter")) return;
      event.preventDefault();
      action();
    });
  }
}

/** Shows rows `{ name, value, of }` or `{ name, text }` in a list, with a bar where there is a total. */
function showNumbers(list, rows) {
  const names = rows.map((row) => row.name).join();
  if (list.dataset.names !== names) {
    list.dataset.names = names;
    list.replaceChildren(...rows.map(({ name, of }) => {
      const number = make("dd", {}, "", ...(of == null ? [] : [make("progress", { ariaLabel: name })]));
      return make("div", {}, make("dt", {}, name), number);
    }));
  }
  rows.forEach(({ value, of, text }, index) => {
    const [, { firstChild, lastElementChild: bar }] = list.children[index].children;
    firstChild.textContent = text ?? (of == null ? round(value) : `${round(value)} of ${round(of)}`);
    if (bar) Object.assign(bar, { max: Math.max(of, 1e-9), value: Math.min(Math.max(value, 0), of) });
  });
}

/** A number with at most three decimals. */
function round(value) {
  return value === null ? "–" : String(Math.round(value * 1000) / 1000);
}
