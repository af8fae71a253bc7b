// The running engines.

import { grouped, processes } from "./numbers.js";

/** The server's list of running engines. */
export async function engines() {
  const answer = await fetch("engines");
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

/** The table of engines, with steps per second since the previous call of `show`. */
export class Table {
  constructor(body, choose) {
    this.body = body;
    this.choose = choose;
    this.before = new Map();
  }

  show(list) {
    const now = performance.now();
    this.body.replaceChildren(...list.map((engine) => this.#row(engine, now)));
    this.before = new Map(list.map((engine) => [engine.incarnation, { steps: engine.env_steps, now }]));
  }

  #row(engine, now) {
    const before = this.before.get(engine.incarnation);
    const rate = before ? ((engine.env_steps - before.steps) / (now - before.now)) * 1000 : null;
    const row = document.createElement("tr");
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = engine.service;
    button.addEventListener("click", () => this.choose(engine.service));
    const cells = [engine.id, `${engine.groups} × ${engine.num_envs}`, grouped(rate), grouped(engine.episodes), processes(engine.trainers)];
    row.append(cell(button), ...cells.map((text) => cell(text)));
    return row;
  }
}

function cell(content) {
  const made = document.createElement("td");
  made.append(content);
  return made;
}
