// The reset parameters as a form, made from the engine's table.

import { make } from "./dom.js";

/** The groups of the parameters, each with a pattern of their names; the first that matches counts. */
const GROUPS = [
  ["Rewards", /^reward_/],
  ["Agent", /^(agent_|sample_agent)/],
  ["Spotlights", /spawn|^spot_/],
  ["Coins and exit", /coin|exit/],
  ["Commands", /command|explosion/],
  ["Picture", /^show_|visual|light|background|chessboard|camera/],
  ["Task", /./],
];

/** Creates the fields of an environment in `place`. `check(options)` throws the engine's error. */
export class ParameterForm {
  #fields = new Map();

  constructor(place, check) {
    this.place = place;
    this.check = check;
  }

  /** Shows the parameters of `spec` with the given texts, and defaults for the rest. */
  show(spec, options) {
    this.#fields.clear();
    const groups = new Map(GROUPS.map(([name]) => [name, []]).reverse());
    for (const parameter of spec.parameters) {
      const [name] = GROUPS.find(([, pattern]) => pattern.test(parameter.name));
      groups.get(name).push(this.#field(parameter, options[parameter.name]));
    }
    const shown = [...groups].filter(([, fields]) => fields.length > 0);
    this.place.replaceChildren(...shown.map(([name, fields]) => make("fieldset", {}, make("legend", {}, name), ...fields)));
    this.validate();
  }

  /** The texts that differ from the defaults. */
  options() {
    const options = {};
    for (const [name, { parameter, input }] of this.#fields) {
      const text = input.type === "checkbox" ? String(input.checked) : input.value.trim();
      if (text !== parameter.default_text && text !== "") options[name] = text;
    }
    return options;
  }

  /** Shows the engine's error at each field. Returns whether all fields are valid. */
  validate() {
    let valid = true;
    const options = this.options();
    for (const [name, { input, error }] of this.#fields) {
      let message = "";
      if (name in options) {
        try {
          this.check({ [name]: options[name] });
        } catch (refused) {
          message = refused.message;
        }
      }
      error.textContent = message && `✕ ${message}`;
      input.setAttribute("aria-invalid", String(message !== ""));
      valid &&= message === "";
    }
    return valid;
  }

  #field(parameter, text) {
    const { name, type, description, default_text: initial, allowed } = parameter;
    const id = `parameter-${name}`;
    const input = make("input", { id, name, autocomplete: "off", spellcheck: false });
    if (type === "bool") Object.assign(input, { type: "checkbox", checked: (text ?? initial) === "true" });
    else Object.assign(input, { value: text ?? initial, inputMode: ["int", "float"].includes(type) ? "decimal" : "" });
    const hint = make("p", { className: "hint", id: `${id}-hint` }, `${description} Default ${initial}; ${allowed}.`);
    const error = make("p", { className: "error", id: `${id}-error` });
    input.setAttribute("aria-describedby", `${hint.id} ${error.id}`);
    input.addEventListener("input", () => this.validate());
    this.#fields.set(name, { parameter, input, error });
    return make("div", { className: "field" }, make("label", { htmlFor: id }, name), input, hint, error);
  }
}
