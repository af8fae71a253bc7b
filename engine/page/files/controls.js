// Controls of actions that no direction stands for: a slider for each number of a box, a list for each branch with other choices, and
// where each choice plays a step, a button for each.

import { make } from "./dom.js";
import { boxAction, choiceName, isTurnBased, unsteered } from "./tasks.js";

export class ActionControls {
  #inputs = [];

  /** Calls `act` when a choice plays a step. */
  constructor(place, act) {
    Object.assign(this, { place, act });
  }

  /** Shows the controls of an environment. */
  show(spec) {
    const box = spec.action_space.Box;
    const isTurn = isTurnBased(spec);
    this.box = Boolean(box);
    this.#inputs = box
      ? box.low.map((low, index) => slider(low, box.high[index]))
      : spec.action_branches.map((_, branch) => (isTurn || unsteered(spec, branch).length > 0 ? choices(spec, branch) : null));
    const [list, ...others] = this.#inputs;
    const button = (text, value) => make("button", { type: "button", onclick: () => this.#choose(value) }, text);
    const label = (input, index) => input && make("label", {}, `${spec.actions[index]?.name ?? `Action ${index}`} `, input);
    const shown = isTurn && others.length === 0
      ? [...list.options].map(({ text, value }) => button(text, value))
      : [...this.#inputs.map(label), isTurn && button("Act")].filter(Boolean);
    this.place.replaceChildren(...shown);
    this.place.hidden = shown.length === 0;
  }

  /** Plays a step with the number of the only branch, or with those of the lists. */
  #choose(number) {
    if (number !== undefined) this.#inputs[0].value = number;
    this.act();
  }

  /** The chosen action; 0 for branches without a control. */
  action() {
    const numbers = this.#inputs.map((input) => Number(input?.value ?? 0));
    return this.box ? boxAction(numbers) : numbers;
  }
}

/** A slider, or a field for numbers if a bound is infinite. */
function slider(low, high) {
  return make("input", { type: low === null || high === null ? "number" : "range", step: "any", min: low ?? "", max: high ?? "", value: 0 });
}

function choices(spec, branch) {
  const numbers = Array.from({ length: spec.action_branches[branch] }, (_, number) => number);
  return make("select", {}, ...numbers.map((number) => new Option(choiceName(spec, branch, number), number)));
}
