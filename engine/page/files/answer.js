// The answer at the end of a visitor's episode: the scores of the visitor and of the page's agents, which play the same episode, and what
// was to be remembered.

import { $, make } from "./dom.js";
import { clueNode } from "./memory.js";
import { scoreOf } from "./tasks.js";

export class Answer {
  #worker = null;
  #shown = null;
  /** The number of the last question to the worker; answers to earlier ones may still arrive. */
  #asked = 0;

  /** Calls `say` with the scores, for screen readers. */
  constructor(engine, agents, say) {
    Object.assign(this, { engine, agents, say });
  }

  /** Shows the answer for the end of an episode; none for null. */
  show(state) {
    if (state === this.#shown) return;
    this.#shown = state;
    this.#asked += 1;
    $("answer").hidden = !state;
    if (!state) return;
    const node = clueNode(state);
    $("compared").replaceChildren(...(node ? [node] : []));
    this.scores = [["You", scoreOf(state)]];
    this.#write();
    const files = this.agents.names(state.id);
    if (files.length === 0) return;
    this.#worker ??= this.#start();
    const { id, options, seed } = state;
    this.#worker.postMessage({ asked: this.#asked, module: this.engine.module, files, episode: { id, options, seed: seed ?? "0" } });
  }

  #start() {
    const worker = new Worker(new URL("score-worker.js", import.meta.url), { type: "module" });
    worker.addEventListener("message", ({ data: { asked, name, state, isOver } }) => {
      if (asked !== this.#asked) return;
      this.scores.push([name, scoreOf(state) + (isOver ? "" : "+")]);
      this.#write();
    });
    return worker;
  }

  #write() {
    if (this.scores.length > 1) this.say(`${this.scores.map((score) => score.join(" ")).join(", ")}.`);
    $("scores").replaceChildren(...this.scores.map(([name, score]) => make("span", {}, `${name} `, make("b", {}, score))));
  }
}
