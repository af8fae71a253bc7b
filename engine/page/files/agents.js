// The trained agents, and their results on the page.

/** The environments with a trained agent of the page, in the file ID.safetensors; docs/train/agents.md describes how to make one. */
const IDS = ["MortarMayhem-Grid-v0", "MysteryPath-Grid-v0", "SearingSpotlights-v0"];

export class Agents {
  #loaded = new Map();
  #counts = new Map();

  constructor(engine) {
    this.engine = engine;
  }

  has(id) {
    return IDS.includes(id) || this.#loaded.has(id);
  }

  /** Why there is no agent, or an empty string. */
  reason(id) {
    return this.has(id) ? "" : `No agent was trained in ${id}; there is one for ${IDS.join(", ")}.`;
  }

  /** The description in a loaded agent's file. */
  description(id) {
    return this.#loaded.get(id);
  }

  /** Loads an agent, once. Throws if its file cannot be loaded or read. */
  async load(id) {
    if (!this.has(id)) throw new Error(this.reason(id));
    if (this.#loaded.has(id)) return this.#loaded.get(id);
    const url = new URL(`${id}.safetensors`, import.meta.url);
    const response = await fetch(url);
    if (!response.ok) throw new Error(`${url} cannot be loaded: ${response.status} ${response.statusText}`);
    return this.#read(new Uint8Array(await response.arrayBuffer()));
  }

  /** Reads an agent's file; the agent plays the environment that it was trained in instead of another one. Returns its description. */
  open(bytes) {
    this.#counts.clear();
    return this.#read(bytes);
  }

  #read(bytes) {
    const description = this.engine.loadAgent(bytes);
    this.#loaded.set(description.env, description);
    return description;
  }

  /** The reset parameters that an agent was trained with, as texts of the form. */
  options(id) {
    return Object.fromEntries(Object.entries(this.description(id).options).map(([name, value]) => [name, JSON.stringify(value)]));
  }

  /** Counts a finished episode of the agent, by environment and reset parameters. */
  count({ id, options }, succeeded) {
    const count = this.counted({ id, options });
    this.#counts.set(key(id, options), { episodes: count.episodes + 1, successes: count.successes + Number(succeeded) });
  }

  counted({ id, options }) {
    return this.#counts.get(key(id, options)) ?? { episodes: 0, successes: 0 };
  }

  /** One sentence about the training. */
  trained(id) {
    const { title, steps, evaluation } = this.description(id);
    // Endless environments have no success.
    const share = ({ options, success, mean_reward: mean }) => {
      const given = Object.entries(options).map(([name, value]) => `${name.replaceAll("_", " ")} ${value}`);
      const score = success === undefined ? `its mean return is ${mean.toFixed(2)}` : `it succeeds in ${Math.round(100 * success)} %`;
      return score + (given.length ? ` with ${given.join(" and ")}` : "");
    };
    const measured = evaluation.map((result) => `; ${share(result)}`).join("");
    return `${title}, trained for ${(steps / 1e6).toFixed(1)} million steps${measured}.`;
  }
}

function key(id, options) {
  return JSON.stringify([id, Object.entries(options).sort()]);
}
