// The tasks of the environments, and how each is steered.

const MORTAR = "Remember the commands, shown one by one: an arrow means a neighbouring tile, a crossed circle stay.";
const GRID = "Left and right turn, up walks ahead.";

/** The entry of the first key that is a part of the id. */
const ofId = (table, id) => Object.entries(table).find(([part]) => id.includes(part))?.[1];

/** What an environment asks of a player, by a part of its id. */
const QUESTIONS = {
  MortarMayhemB: "Can you follow the commands?",
  MortarMayhem: "How many can you remember?",
  MysteryPath: "Do you remember the way?",
  SearingSpotlights: "Where was the coin?",
};

/** The question of an environment; empty for others than those of Memory Gym. */
export function questionOf(id) {
  return ofId(QUESTIONS, id) ?? "";
}

/** Two sentences for each id. */
export const TASKS = {
  "MortarMayhem-v0":
    `${MORTAR} Then carry them out in order, on the right tile each time the others burn.`,
  "MortarMayhem-Grid-v0":
    `${MORTAR} Then carry them out in order; ${GRID.toLowerCase()}`,
  "MortarMayhemB-v0":
    "Carry out the commands in order, on the right tile each time the others burn.",
  "MortarMayhemB-Grid-v0":
    `Carry out the commands in order, on the right tile each time the others burn. ${GRID}`,
  "Endless-MortarMayhem-v0":
    "Remember the command that is shown and carry out all commands so far, from the first; each round adds one. " +
    "The arena has no border: leaving it on one side means entering on the other.",
  "MysteryPath-v0":
    "Find the invisible path to the goal on the opposite side. A step off the path leads back to the start, so remember where it was.",
  "MysteryPath-Grid-v0":
    `Find the invisible path to the goal on the opposite side and remember where a fall led back to the start. ${GRID}`,
  "Endless-MysteryPath-v0":
    "Follow the invisible path to the right; after a fall, walk it again from memory. " +
    "A second fall at the same place, a fall before the farthest point or lost stamina ends the episode.",
  "SearingSpotlights-v0":
    "Collect the coin and leave by the exit, both hidden in the dark once the light goes off. Spotlights cost health.",
  "Endless-SearingSpotlights-v0":
    "Collect one coin after the other; each is visible for a moment only. Spotlights cost health, and time runs out without a coin.",
};

/** What the colours of an environment's ground-truth view mean, by a part of its id; the first that matches counts. */
const COLORS = {
  MortarMayhem: [["#00ff00", "ring: the tile to be on"], ["#701824", "burning tiles"]],
  "Endless-MysteryPath": [["#c8c8c8", "the path"], ["#00ff00", "stamina"], ["#ff0000", "spent stamina"]],
  MysteryPath: [["#ffffff", "the path"], ["#0000ff", "start"], ["#00ff00", "goal"], ["#ff0000", "walls beside it"]],
  "Endless-SearingSpotlights": [["#ffa500", "coin"], ["#00ff00", "health"]],
  SearingSpotlights: [["#ffa500", "coins"], ["#373737", "closed exit"], ["#308d46", "open exit"], ["#00ff00", "health"]],
};

/** Pairs of a colour and its meaning; none where the environment's own view is unknown. */
export function legendOf(id) {
  return ofId(COLORS, id) ?? [];
}

const DIRECTION_NAMES = { left: ["left"], right: ["right"], up: ["up", "ahead"], down: ["down"] };
const DIRECTION_SIGNS = { left: "←", right: "→", up: "↑", down: "↓" };

/** For each direction that a choice of the environment is named after: the branch of the action and its number. */
export function steering(spec) {
  const meaning = {};
  for (const [direction, names] of Object.entries(DIRECTION_NAMES)) {
    spec.actions.forEach(({ choices }, branch) => {
      const number = choices.findIndex(({ name }) => names.includes(name));
      if (number >= 0) meaning[direction] ??= [branch, number];
    });
  }
  return meaning;
}

/** The numbers of a branch that neither a direction nor doing nothing, which is 0, stands for. */
export function unsteered(spec, branch) {
  const steered = new Set(Object.values(steering(spec)).filter(([other]) => other === branch).map(([, number]) => number));
  return Array.from({ length: spec.action_branches[branch] - 1 }, (_, index) => index + 1).filter((number) => !steered.has(number));
}

/** What a number of a branch means. */
export function choiceName(spec, branch, number) {
  return spec.actions[branch]?.choices[number]?.name ?? String(number);
}

/** The action for directions; the last direction of a branch counts. Without any, a branch has its number in `given`. */
export function actionFor(spec, directions, given) {
  const action = [...given];
  const meaning = steering(spec);
  for (const direction of directions) {
    if (meaning[direction]) action[meaning[direction][0]] = meaning[direction][1];
  }
  return action;
}

/** Whether no choice is a direction, so that each one plays a step. */
export function isTurnBased(spec) {
  return !spec.action_space.Box && Object.keys(steering(spec)).length === 0;
}

/** Whether a person who chooses nothing does not act. */
export function waits(spec) {
  return isTurnBased(spec) || Object.values(steering(spec)).some(([, number]) => number === 0);
}

/** An action in a few signs and words. */
export function actionText(spec, action) {
  if (spec.action_space.Box) return [...boxNumbers(action)].map((number) => number.toPrecision(3)).join(", ");
  const meaning = Object.entries(steering(spec));
  const sign = (number, branch) => {
    const direction = meaning.find(([, [steered, meant]]) => steered === branch && meant === number)?.[0];
    if (direction) return DIRECTION_SIGNS[direction];
    return number === 0 && unsteered(spec, branch).length === 0 ? "" : choiceName(spec, branch, number);
  };
  return action.map(sign).filter(Boolean).join(" ") || "nothing";
}

/** The numbers of an action in a box, whose bits the engine takes as integers. */
export function boxNumbers(action) {
  return new Float32Array(Int32Array.from(action).buffer);
}

/** The action in a box with these numbers. */
export function boxAction(numbers) {
  return [...new Int32Array(Float32Array.from(numbers).buffer)];
}

// In the order of the vector observation.
const COMMANDS = ["stay", "right", "left", "up", "down", "right down", "right up", "left down", "left up"];
const ARROWS = { stay: "⊗", right: "→", left: "←", up: "↑", down: "↓", "right down": "↘", "right up": "↗", "left down": "↙", "left up": "↖" };

/** The sign of a command. */
export function arrowOf(command) {
  return ARROWS[command];
}

/** What is counted in an episode: the longest sequence of commands, or what the engine counts first. */
function counted({ progress, clues, done }) {
  const [first] = progress;
  if (!first) return null;
  if (first.name !== "commands" || first.of !== null) return first;
  // A sequence counts once it is carried out whole.
  const { commands, carried_out: carried } = clues;
  const whole = !done && commands.length > 0 && commands.every((command, place) => carried[place] === command);
  return { name: "commands", value: Math.max(0, commands.length - (whole ? 0 : 1)), of: null };
}

/** A player's score in an episode so far, such as `6` or `3 of 5`. */
export function scoreOf(state) {
  const { value, of } = counted(state) ?? { value: state.return, of: null };
  const text = (number) => String(Math.round(number * 100) / 100);
  return of === null ? text(value) : `${text(value)} of ${text(of)}`;
}

/** The number of that score. */
export function scoreNumber(state) {
  return counted(state)?.value ?? state.return;
}

/** What the score counts, such as `commands`. */
export function unitOf(state) {
  return counted(state)?.name ?? "return";
}

/** How an episode ended: `success`, `failure`, `end` if the environment defines no success, or null before its end. */
export function outcomeOf(state) {
  if (!state.done) return null;
  // In Mortar Mayhem, the original counts a failed last command as a success; the task progress does not.
  const done = state.info?.task_progress ?? state.info?.success;
  if (done === undefined) return "end";
  return done === 1 ? "success" : "failure";
}

/** The commands in the vector observation of MortarMayhemB, as arrows and as words. */
export function commandsOf({ id, vector }) {
  const commands = [];
  for (let start = 0; id.startsWith("MortarMayhemB") && start < vector.length; start += COMMANDS.length) {
    const place = vector.slice(start, start + COMMANDS.length).indexOf(1);
    if (place >= 0) commands.push(COMMANDS[place]);
  }
  return { arrows: commands.map((command) => ARROWS[command]).join(" "), words: commands.join(", ") };
}
