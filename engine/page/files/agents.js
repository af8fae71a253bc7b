// The trained agents, and their results on the page.

/** Minutes of training on one core of the page's agents, by the name of their file without its ending: the id of the environment, with
    `-none` for an agent without memory. */
const MINUTES = {
  "Endless-MortarMayhem-v0": 32,
  "Endless-MortarMayhem-v0-none": 3,
  "Endless-MysteryPath-v0": 7,
  "Endless-MysteryPath-v0-none": 1,
  "Endless-SearingSpotlights-v0": 5,
  "Endless-SearingSpotlights-v0-none": 1,
  "MortarMayhem-Grid-v0": 12,
  "MysteryPath-Grid-v0": 17,
  "SearingSpotlights-v0": 9,
};

/** The environments with an agent that has a memory. */
const PLAYED = Object.keys(MINUTES).filter((name) => !name.endsWith("-none"));

export class Agents {
  #loaded = new Map();
  /** The environments whose agent is that of an opened file. */
  #own = new Set();
  #counts = new Map();

  constructor(engine) {
    this.engine = engine;
  }

  has(id) {
    return PLAYED.includes(id) || this.#loaded.has(id);
  }

  /** The page's files of agents for an environment, that with memory first. */
  names(id) {
    return [id, `${id}-none`].filter((name) => name in MINUTES);
  }

  /** Why there is no agent, or an empty string. */
  reason(id) {
    return this.has(id) ? "" : `No agent was trained in ${id}; there is one for ${PLAYED.join(", ")}.`;
  }

  /** The description in a loaded agent's file. */
  description(id) {
    return this.#loaded.get(id);
  }

  /** Loads an agent, once. Throws if its file cannot be loaded or read. */
  async load(id) {
    if (!this.has(id)) throw new Error(this.reason(id));
    if (this.#loaded.has(id)) return this.#loaded.get(id);
    return this.#read(await this.file(id));
  }

  /** The bytes of one of the page's files. */
  async file(name) {
    const url = new URL(`${name}.safetensors`, import.meta.url);
    const response = await fetch(url);
    if (!response.ok) throw new Error(`${url} cannot be loaded: ${response.status} ${response.statusText}`);
    return new Uint8Array(await response.arrayBuffer());
  }

  /** Reads an agent's file; the agent plays the environment that it was trained in instead of another one. Returns its description. */
  open(bytes) {
    const description = this.#read(bytes);
    this.#counts.clear();
    this.#own.add(description.env);
    return description;
  }

  /** Whether an environment's agent is that of an opened file, which a link cannot name. */
  isOwn(id) {
    return this.#own.has(id);
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
  count({ id, options }, succeeded, score) {
    const count = this.counted({ id, options });
    const sums = { episodes: count.episodes + 1, successes: count.successes + Number(succeeded), score: count.score + score };
    this.#counts.set(key(id, options), sums);
  }

  counted({ id, options }) {
    return this.#counts.get(key(id, options)) ?? { episodes: 0, successes: 0, score: 0 };
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
    const trained = steps < 1e6 ? steps.toLocaleString("en") : `${(steps / 1e6).toFixed(1)} million`;
    const minutes = this.isOwn(id) ? "" : `, ${MINUTES[id]} minutes on one core`;
    return `${title}, trained for ${trained} steps${minutes}${measured}.`;
  }
}

function key(id, options) {
  return JSON.stringify([id, Object.entries(options).sort()]);
}
