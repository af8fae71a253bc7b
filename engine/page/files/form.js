// The reset parameters as a form, made from the engine's table.

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
    this.place.replaceChildren(...shown.map(([name, fields]) => {
      const group = document.createElement("fieldset");
      group.append(Object.assign(document.createElement("legend"), { textContent: name }), ...fields);
      return group;
    }));
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
    const field = document.createElement("div");
    field.className = "field";
    const id = `parameter-${parameter.name}`;
    const label = document.createElement("label");
    label.htmlFor = id;
    label.textContent = parameter.name;
    const input = document.createElement("input");
    input.id = id;
    input.name = parameter.name;
    input.autocomplete = "off";
    input.spellcheck = false;
    if (parameter.type === "bool") {
      input.type = "checkbox";
      input.checked = (text ?? parameter.default_text) === "true";
    } else {
      input.value = text ?? parameter.default_text;
      if (parameter.type !== "int_list") input.inputMode = "decimal";
    }
    const hint = document.createElement("p");
    hint.className = "hint";
    hint.id = `${id}-hint`;
    hint.textContent = `${parameter.description} Default ${parameter.default_text}; ${parameter.allowed}.`;
    const error = document.createElement("p");
    error.className = "error";
    error.id = `${id}-error`;
    input.setAttribute("aria-describedby", `${hint.id} ${error.id}`);
    input.addEventListener("input", () => this.validate());
    field.append(label, input, hint, error);
    this.#fields.set(parameter.name, { parameter, input, error });
    return field;
  }
}
