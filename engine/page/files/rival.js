// An agent without memory, which plays the same episode beside the one with memory.

import { $ } from "./dom.js";
import { Engine } from "./engine.js";
import { scoreOf, unitOf } from "./tasks.js";

export class Rival {
  #engine = null;
  #wanted = null;
  #state = null;

  constructor(engine, agents) {
    this.module = engine.module;
    this.agents = agents;
  }

  /** Starts the episode of `state` for the rival, or hides it. */
  async begin(state, isWanted) {
    [this.#wanted, this.#state] = [isWanted ? state : null, null];
    $("rival").hidden = !isWanted;
    if (!isWanted) return;
    // Another engine, which holds another agent of the same environment.
    this.#engine ??= Engine.of(this.module);
    const [engine, file] = await Promise.all([this.#engine, this.agents.file(`${state.id}-none`)]);
    if (this.#wanted !== state) return;
    engine.loadAgent(file);
    const { id, options, seed } = state;
    this.#state = engine.request({ start: { id, options, seed } });
    this.engine = engine;
  }

  /** Plays to the step of the other agent, and shows both scores. */
  follow(other, { shown }) {
    if (!this.#state || !this.#wanted) return;
    const most = other.length - this.#state.length;
    if (most > 0 && !this.#state.done) this.#state = this.engine.request({ steps_of_agent: { most } });
    const canvas = $("rival-picture");
    if (canvas.width !== shown.width) Object.assign(canvas, { width: shown.width, height: shown.height });
    canvas.getContext("2d").putImageData(this.engine.observation(shown), 0, 0);
    $("rival").classList.toggle("over", this.#state.done);
    $("rival-score").textContent = scoreOf(this.#state);
    $("rival-unit").textContent = unitOf(this.#state);
    $("rival-said").textContent = this.#state.done ? `Over after ${this.#state.length} steps. With memory: ${scoreOf(other)}.` : `With memory: ${scoreOf(other)}.`;
  }
}
