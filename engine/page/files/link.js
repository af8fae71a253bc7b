// The address: environment, seed, player and reset parameters, or a wall.

/** One of the paper's training seeds. */
export const randomSeed = () => String(crypto.getRandomValues(new Uint32Array(1))[0] % 100_000);

/** Parses an address. */
export function readLink(hash) {
  const fields = new URLSearchParams(hash.replace(/^#/, ""));
  const take = (name) => {
    const value = fields.get(name);
    fields.delete(name);
    return value;
  };
  const wall = take("wall");
  if (wall !== null) return { wall, count: take("count"), by: take("by"), options: Object.fromEntries(fields) };
  const id = take("env");
  const seed = take("seed");
  const by = take("by");
  return { id, seed, by, options: Object.fromEntries(fields) };
}

/** The address of an episode; `by` is the player, if not a person. */
export function episodeLink({ id, seed, options, by }) {
  return "#" + new URLSearchParams({ env: id, seed, ...(by ? { by } : {}), ...options });
}

/** The address of a wall. */
export function wallLink({ wall, count, by, options }) {
  return "#" + new URLSearchParams({ wall, count, by, ...options });
}
