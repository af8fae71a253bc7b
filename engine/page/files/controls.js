// Controls of actions that no direction stands for: a slider for each number of a box, and a list for each branch with other choices.

import { boxAction, choiceName, unsteered } from "./tasks.js";

export class ActionControls {
  #inputs = [];

  constructor(place) {
    this.place = place;
  }

  /** Shows the controls of an environment. */
  show(spec) {
    const box = spec.action_space.Box;
    this.box = Boolean(box);
    this.#inputs = box
      ? box.low.map((low, index) => slider(low, box.high[index]))
      : spec.action_branches.map((_, branch) => (unsteered(spec, branch).length > 0 ? choices(spec, branch) : null));
    this.place.replaceChildren(...this.#inputs.flatMap((input, index) => {
      if (!input) return [];
      const label = document.createElement("label");
      label.append(`${spec.actions[index]?.name ?? `Action ${index}`} `, input);
      return [label];
    }));
    this.place.hidden = this.place.childElementCount === 0;
  }

  /** The chosen action; 0 for branches without a control. */
  action() {
    const numbers = this.#inputs.map((input) => Number(input?.value ?? 0));
    return this.box ? boxAction(numbers) : numbers;
  }
}

/** A slider, or a field for numbers if a bound is infinite. */
function slider(low, high) {
  const input = document.createElement("input");
  Object.assign(input, { type: low === null || high === null ? "number" : "range", step: "any", min: low ?? "", max: high ?? "" });
  input.value = 0;
  return input;
}

function choices(spec, branch) {
  const select = document.createElement("select");
  for (let number = 0; number < spec.action_branches[branch]; number += 1) {
    select.append(new Option(choiceName(spec, branch, number), number));
  }
  return select;
}
