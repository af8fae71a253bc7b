// The trained agents, and their results on the page.

/** The environments with a trained agent, in the file ID.safetensors; docs/train/agents.md describes how to make one. */
const IDS = ["MortarMayhem-Grid-v0", "MysteryPath-Grid-v0", "SearingSpotlights-v0"];

export class Agents {
  #loaded = new Map();
  #counts = new Map();

  constructor(engine) {
    this.engine = engine;
  }

  has(id) {
    return IDS.includes(id);
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
    this.#loaded.set(id, this.engine.loadAgent(new Uint8Array(await response.arrayBuffer())));
    return this.#loaded.get(id);
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
    const { agent, steps, evaluation } = this.description(id);
    const share = ({ options, success }) => {
      const given = Object.entries(options).map(([name, value]) => `${name.replaceAll("_", " ")} ${value}`);
      return `${Math.round(100 * success)} %` + (given.length ? ` with ${given.join(" and ")}` : "");
    };
    const kind = { gru: "A GRU", mingru: "A minGRU", none: "An agent without memory" }[agent];
    const measured = evaluation.length ? `; it succeeds in ${evaluation.map(share).join(", ")}` : "";
    return `${kind}, trained for ${(steps / 1e6).toFixed(1)} million steps${measured}.`;
  }
}

function key(id, options) {
  return JSON.stringify([id, Object.entries(options).sort()]);
}
