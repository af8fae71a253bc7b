// The tasks of the environments, and how each is steered.

const MORTAR = "Remember the commands that are shown one after another: arrows name a neighbouring tile, a crossed circle means stay.";
const GRID = "Left and right turn the agent, up walks to the tile ahead.";

/** Two sentences for each id. */
export const TASKS = {
  "MortarMayhem-v0":
    `${MORTAR} Then carry them out in that order and be on the right tile each time the others turn red.`,
  "MortarMayhem-Grid-v0":
    `${MORTAR} Then carry them out in that order; ${GRID.toLowerCase()}`,
  "MortarMayhemB-v0":
    "Carry out the listed commands in order, from tile to tile. Be on the right tile each time the others turn red.",
  "MortarMayhemB-Grid-v0":
    `Carry out the listed commands in order and be on the right tile each time the others turn red. ${GRID}`,
  "Endless-MortarMayhem-v0":
    "Remember the command that is shown and carry out all commands so far, from the first; each round adds one. " +
    "The arena has no border: leaving it on one side means entering on the other.",
  "MysteryPath-v0":
    "Find the invisible path to the goal on the opposite side. A step off the path leads back to the start, so remember where it was.",
  "MysteryPath-Grid-v0":
    `Find the invisible path to the goal on the opposite side and remember where a fall led back to the start. ${GRID}`,
  "Endless-MysteryPath-v0":
    "Follow the invisible path to the right; a fall leads back to the start, and the path must then be walked from memory. " +
    "A second fall at the same place, a fall before the farthest point or lost stamina ends the episode.",
  "SearingSpotlights-v0":
    "Collect the coin and leave by the exit, both hidden in the dark once the light goes off. Spotlights cost health.",
  "Endless-SearingSpotlights-v0":
    "Collect one coin after the other; each is visible for a moment only. Spotlights cost health, and time runs out without a coin.",
};

const FREE = { left: [0, 1], right: [0, 2], up: [1, 1], down: [1, 2] };
const TURN = { left: [0, 1], right: [0, 2], up: [0, 3] };
const AHEAD = { right: [0, 1], up: [0, 2], down: [0, 3] };

/** For each direction that the environment has: the branch of the action and its number. */
export function steering(spec) {
  if (spec.id === "Endless-MysteryPath-v0") return AHEAD;
  return spec.action_branches.length === 2 ? FREE : TURN;
}

/** The action for directions; the last direction of a branch counts. */
export function actionFor(spec, directions) {
  const action = spec.action_branches.map(() => 0);
  const meaning = steering(spec);
  for (const direction of directions) {
    if (meaning[direction]) action[meaning[direction][0]] = meaning[direction][1];
  }
  return action;
}

/** The directions that an action stands for. */
export function directionsOf(spec, action) {
  const meaning = Object.entries(steering(spec));
  return meaning.filter(([, [branch, number]]) => action[branch] === number).map(([direction]) => direction);
}

// In the order of the vector observation.
const COMMANDS = ["stay", "right", "left", "up", "down", "right down", "right up", "left down", "left up"];
const ARROWS = { stay: "⊗", right: "→", left: "←", up: "↑", down: "↓", "right down": "↘", "right up": "↗", "left down": "↙", "left up": "↖" };

/** The sign of a command. */
export function arrowOf(command) {
  return ARROWS[command];
}

/** How an episode ended: `success`, `failure`, `end` if the environment defines no success, or null before its end. */
export function outcomeOf(state) {
  if (!state.done) return null;
  if (!("success" in (state.info ?? {}))) return "end";
  // The original counts a failed last command as a success; the progress does not.
  const complete = !state.id.startsWith("MortarMayhem") || state.progress.every(({ value, of }) => value >= of);
  return state.info.success === 1 && complete ? "success" : "failure";
}

/** The commands of a vector observation, as arrows and as words. */
export function commandsOf(vector) {
  const commands = [];
  for (let start = 0; start < vector.length; start += COMMANDS.length) {
    const place = vector.slice(start, start + COMMANDS.length).indexOf(1);
    if (place >= 0) commands.push(COMMANDS[place]);
  }
  return { arrows: commands.map((command) => ARROWS[command]).join(" "), words: commands.join(", ") };
}
