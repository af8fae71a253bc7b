// The running engines.

import { make } from "./dom.js";
import { grouped, processes } from "./numbers.js";

/** The server's list of running engines. */
export async function engines() {
  const answer = await fetch("engines");
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

/** Milliseconds over which steps per second are averaged, as in the curves. */
const WINDOW = 10_000;

/** The table of engines. */
export class Table {
  constructor(body, choose) {
    this.body = body;
    this.choose = choose;
    // By run, the counts of the window and the last one before it.
    this.counts = new Map();
  }

  show(list) {
    const now = performance.now();
    this.counts = new Map(list.map(({ incarnation, env_steps: steps }) => {
      const counts = [...(this.counts.get(incarnation) ?? []), { steps, now }];
      return [incarnation, counts.slice(Math.max(0, counts.findLastIndex((count) => now - count.now >= WINDOW)))];
    }));
    this.body.replaceChildren(...list.map((engine) => this.#row(engine)));
  }

  #row(engine) {
    const [first, last] = [0, -1].map((place) => this.counts.get(engine.incarnation).at(place));
    const rate = first === last ? null : ((last.steps - first.steps) / (last.now - first.now)) * 1000;
    const button = make("button", { type: "button" }, engine.service);
    button.addEventListener("click", () => this.choose(engine.service));
    const cells = [engine.id, `${engine.groups} × ${engine.num_envs}`, grouped(rate), grouped(engine.episodes), processes(engine.trainers)];
    return make("tr", {}, ...[button, ...cells].map((cell) => make("td", {}, cell)));
  }
}
